"""How long a unit of a map is likely to be: rooms are as high as rooms are, and photos taken at about eye level."""

from __future__ import annotations

from dataclasses import dataclass

# Metres from floor to ceiling, and from the floor to a camera that is held or on a robot: least, most, likely.
_CEILING = (2.2, 3.6, 2.6)
_CAMERA = (0.3, 2.0, 1.4)


@dataclass(frozen=True)
class Unit:
    """Metres in a unit of the map frame.

    Attributes:
        low, likely, high: metres.
        by: what tells it.
    """

    low: float
    likely: float
    high: float
    by: str

    @property
    def may_be_metre(self) -> bool:
        """Whether the map may be in metres."""
        return self.low <= 1.0 <= self.high


def find_unit(floor: float | None, ceiling: float | None, camera_height: float | None) -> Unit | None:
    """Return the unit that heights along up tell, the ceiling's before that of the photos; None if there are none.

    Args:
        floor, ceiling: heights in map units.
        camera_height: median height of the photos' cameras.
    """
    if floor is None:
        return None
    if ceiling is not None:
        return _unit(ceiling - floor, _CEILING, "the ceiling is {:.3g} units above the floor")
    if camera_height is not None and camera_height > floor:
        return _unit(camera_height - floor, _CAMERA, "the photos were taken {:.3g} units above the floor")
    return None


def _unit(height: float, metres: tuple[float, float, float], words: str) -> Unit:
    low, high, likely = (each / height for each in metres)
    return Unit(low, likely, high, words.format(height))
