"""Parameters of stages, derived from other parameters."""

from reffusion.params.base import Settings


def with_changes(params: Settings, **changes) -> Settings:
    """Return a validated copy of the parameters with some values changed.

    A dict changes only the named values of a group: with_changes(params, seed=1, sds={"weight": 0}).
    """
    values = params.model_dump()
    for name, change in changes.items():
        values[name] = values[name] | change if isinstance(change, dict) else change
    return type(params)(**values)
