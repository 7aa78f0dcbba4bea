"""RefFusion for nerfbaselines: a data set, a protocol and a method; see spec.py.

nerfbaselines needs numpy 1, RefFusion numpy 2, so each has an environment of its own: what RefFusion does here is done
by worker.py, in RefFusion's.
"""
