"""What can be told of `masks` before it runs."""

from reffusion.params.masks import Params

__all__ = ["Params"]
