"""LichtFeld Studio plug-in: a panel that fills the hole which deleted splats leave, by `reffusion patch`."""

import lichtfeld as lf

from .panel import FillPanel


def on_load():
    lf.register_class(FillPanel)


def on_unload():
    lf.unregister_class(FillPanel)
