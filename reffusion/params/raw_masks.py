"""Parameters of the stage `raw_masks`: the keys of scene.yaml, as `poses` reads them."""

from reffusion.params.capture import SceneKeys as Params

__all__ = ["Params"]
