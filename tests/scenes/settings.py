"""Parameters derived from others."""

from reffusion.params.base import Settings


def with_changes(params: Settings, **changes) -> Settings:
    """`params` with other values, checked; of a group some of them: altered(params, seed=1, sds={"weight": 0})."""
    values = params.model_dump()
    for name, change in changes.items():
        values[name] = values[name] | change if isinstance(change, dict) else change
    return type(params)(**values)
