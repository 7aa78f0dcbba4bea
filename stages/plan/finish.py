"""Facts about the stage `finish` that the runner needs before the stage runs; imports nothing heavy."""

from reffusion.params.finish import Params

__all__ = ["Params"]
