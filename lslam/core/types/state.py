"""What an object needs to go on where it was: numbers, text, arrays, and nothing else, so that a file of it cannot run code."""

from __future__ import annotations

from typing import Any, ClassVar

# Attribute -> None, bool, int, float, str, array, a dataclass of such, a list, tuple or dict of such, or another State.
State = dict[str, Any]


class Stateful:
    """An object whose mutable state consists of the attributes named in `STATE`.

    `state` refers to the live object: write it before the object continues. `restore` needs an object made with the
    same arguments. Attributes named in `TRANSIENT` are recomputed after it, and None until then.
    """

    STATE: ClassVar[tuple[str, ...]] = ()
    TRANSIENT: ClassVar[tuple[str, ...]] = ()

    def state(self) -> State:
        """The values of the attributes in `STATE`, for a checkpoint."""
        return {name: _state_of(getattr(self, name)) for name in self.STATE}

    def restore(self, state: State) -> None:
        """Set the attributes from a saved `state`. Raises KeyError for the state of another class."""
        for name in self.STATE:
            part = getattr(self, name)
            if isinstance(part, Stateful):
                part.restore(state[name])
            else:
                setattr(self, name, state[name])
        for name in self.TRANSIENT:
            setattr(self, name, None)


def _state_of(value: Any) -> Any:
    """The state of an object that has one, any other value itself."""
    return value.state() if isinstance(value, Stateful) else value
