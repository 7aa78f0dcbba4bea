"""Parameters derived from others."""

from reffusion.params.base import Settings


def with_changes(params: Settings, **changes) -> Settings:
    """A validated copy with other values; groups are merged: with_changes(params, seed=1, sds={"weight": 0})."""
    values = params.model_dump()
    for name, change in changes.items():
        values[name] = values[name] | change if isinstance(change, dict) else change
    return type(params)(**values)
