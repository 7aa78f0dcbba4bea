# CPU: docker build --tag reffusion . (docs/guide.md says how to run it)
FROM python:3.11-slim

# GCC's OpenMP, for numba.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --no-install-recommends --yes libgomp1 \
    && rm -rf /var/lib/apt/lists/*

WORKDIR /src
COPY constraints.txt .
# torch without CUDA: its version is that of constraints.txt, with the local part +cpu.
RUN pip install --no-cache-dir --constraint constraints.txt \
    --extra-index-url https://download.pytorch.org/whl/cpu "$(sed -n 's/^\(torch==.*\)/\1+cpu/p' constraints.txt)"
COPY . .
RUN pip install --no-cache-dir --constraint constraints.txt '.[view,export,heic]'

# Any user may run it, so that results belong to who starts it: --user "$(id -u):$(id -g)".
RUN useradd --uid 1001 --create-home --home-dir /reffusion reffusion \
    && mkdir /reffusion/data /reffusion/runs /reffusion/.cache \
    && chown reffusion /reffusion/* /reffusion/.cache && chmod 1777 /reffusion /reffusion/* /reffusion/.cache
USER 1001
WORKDIR /reffusion
# Weights and compiled kernels are in the cache.
ENV HOME=/reffusion USER=reffusion
VOLUME ["/reffusion/data", "/reffusion/runs", "/reffusion/.cache"]
ENTRYPOINT ["reffusion"]
