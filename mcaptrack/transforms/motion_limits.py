"""Limits of the motion of each class, and its size: one table for trackers and re-tracking.

Classes are found by name, because their numbers differ from detector to detector. Users replace rows of the table by
the option ``class_limits``. Letters: C classes.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

from mcaptrack.errors import McaptrackError

#: Names of classes by their numbers, as a parameter of transforms.
ClassNames = tuple[tuple[int, str], ...]
#: Texts of the option ``class_limits`` of transforms.
LIMITS_PATTERN: Final = r"[\w -]+=[\d.:]+(, ?[\w -]+=[\d.:]+)*"
#: Help text of the option ``class_limits`` of transforms.
LIMITS_HELP: Final = (
    "limits of the motion of a class instead of those of the table: NAME=SPEED:DRIFT:NOISE:GATE in m/s, m/s within a "
    "second, m and m, as in car=40,pedestrian=4::0.1"
)


class MotionLimits(NamedTuple):
    """Limits of the motion of a class.

    Attributes
    ----------
    name : str
        The name of the row of the table.
    speed_m_per_s : float
        The usual speed: standard deviation per axis of the velocity of a new track.
    max_speed_m_per_s : float
        No object of this class is faster.
    drift_m_per_s : float
        How much velocities change within a second.
    noise_m : float
        Noise of measured positions: standard deviation per axis.
    gate_m : float
        The largest distance between a detection and the predicted position of its track.
    turns : bool
        Whether it moves on arcs along its heading, as vehicles do.
    size_m : tuple of 3 floats
        The usual length, width and height.
    """

    name: str
    speed_m_per_s: float
    max_speed_m_per_s: float
    drift_m_per_s: float
    noise_m: float
    gate_m: float
    turns: bool
    size_m: tuple[float, float, float]


#: The row for classes that are in no other row, or that have no name.
UNKNOWN: Final = "unknown"
_TABLE: Final = (
    #             name          usual   most  drift  noise  gate  turns  length, width, height
    MotionLimits("person",       1.75,   6.0,  0.8,  0.20,  1.5, False, (0.6, 0.6, 1.75)),
    MotionLimits("bicycle",      3.5,   15.0,  1.5,  0.20,  2.0, True,  (1.8, 0.6, 1.70)),
    MotionLimits("motorcycle",   7.0,   60.0,  3.0,  0.20,  2.5, True,  (2.1, 0.8, 1.60)),
    MotionLimits("car",          7.0,   60.0,  3.0,  0.25,  3.0, True,  (4.6, 1.9, 1.70)),
    MotionLimits("bus",          6.0,   35.0,  2.0,  0.30,  4.0, True,  (11.5, 2.9, 3.30)),
    MotionLimits("truck",        6.0,   35.0,  2.0,  0.30,  4.0, True,  (8.0, 2.5, 3.20)),
    MotionLimits("trailer",      6.0,   35.0,  2.0,  0.30,  4.0, True,  (10.0, 2.6, 3.40)),
    MotionLimits("train",       10.0,   90.0,  1.5,  0.30,  5.0, True,  (20.0, 2.8, 3.80)),
    MotionLimits("animal",       2.0,   18.0,  2.0,  0.20,  1.5, False, (1.0, 0.4, 0.80)),
    MotionLimits("object",       0.3,    1.0,  0.2,  0.20,  1.0, False, (0.5, 0.5, 0.90)),
    MotionLimits(UNKNOWN,        4.0,   40.0,  2.0,  0.25,  2.5, False, (2.0, 1.5, 1.70)),
)  # fmt: skip
#: The table of limits by name.
LIMITS: Final[Mapping[str, MotionLimits]] = {row.name: row for row in _TABLE}

#: Words in names of classes, as data sets and drivers write them, and their row. The first that a name has counts:
#: "bus_stop" is none of them, "vehicle.construction" is a truck, "vehicle" alone a car.
_WORDS: Final[Sequence[tuple[str, str]]] = (
    *((word, "object") for word in ("cone", "barrier", "bollard", "sign", "debris", "static", "pole", "stop")),
    *((word, "trailer") for word in ("trailer", "semitrailer")),
    *((word, "bus") for word in ("bus", "coach", "buses")),
    *((word, "train") for word in ("train", "tram", "rail", "railed", "streetcar")),
    *((word, "truck") for word in ("truck", "lorry", "construction", "large", "heavy", "cab", "big", "excavator")),
    *((word, "motorcycle") for word in ("motorcycle", "motorcyclist", "motorbike", "moped", "scooter")),
    *((word, "bicycle") for word in ("bicycle", "bicyclist", "cyclist", "bike", "cycle", "wheeled", "rider")),
    *((word, "animal") for word in ("animal", "dog", "cat", "horse", "cow", "deer", "bird", "sheep")),
    *((word, "person") for word in ("person", "pedestrian", "human", "people", "man", "woman", "child", "adult")),
    *((word, "person") for word in ("worker", "officer", "stroller", "wheelchair", "walker", "ped")),
    *((word, "car") for word in ("car", "van", "taxi", "pickup", "suv", "emergency", "vehicle", "auto", "automobile")),
)


@lru_cache(maxsize=1024)
def limits_row(name: str) -> str:
    """The row of the table for a class of this name: ``UNKNOWN`` if none fits.

    Examples
    --------
    >>> [limits_row(name) for name in ("human.pedestrian.adult", "REGULAR_VEHICLE", "TYPE_CYCLIST", "Van", "blob")]
    ['person', 'car', 'bicycle', 'car', 'unknown']
    """
    parts = re.split(r"[^a-z]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower())
    singular = {part.removesuffix("s") for part in parts}
    return next((row for word, row in _WORDS if word.removesuffix("s") in singular), UNKNOWN)


def limits_of(name: str, own: Mapping[str, MotionLimits] | None = None) -> MotionLimits:
    """The limits of a class by its name; ``own`` are those of ``read_limits``, which stand before the table."""
    row = limits_row(name)
    return (own or {}).get(name.strip().lower()) or (own or {}).get(row) or LIMITS[row]


def limits_by_class(numbers: Sequence[int], names: ClassNames, class_limits: str = "") -> dict[int, MotionLimits]:
    """The limits of classes by their number; ``names`` name them, and ``class_limits`` replace rows of the table."""
    own, named = read_limits(class_limits), dict(names) or {1: "person"}
    return {number: limits_of(named.get(number, UNKNOWN), own) for number in numbers}


def unknown_limits(class_limits: str, names: ClassNames) -> list[str]:
    """The names in ``class_limits`` that are in no row of the table and not among those of classes.

    Examples
    --------
    >>> unknown_limits("caar=4, forklift=6, van=30", ((1, "Forklift"), (3, "car")))
    ['caar']
    """
    named = {name.strip().lower() for _, name in names}
    return [name for name in read_limits(class_limits) if limits_row(name) == UNKNOWN and name not in named | {UNKNOWN}]


def units_m(numbers: Sequence[int], names: ClassNames, class_limits: str = "") -> list[float]:
    """For each class the unit of length, in metres, in which its objects move as people do.

    What is made for people, as predictors are, works for other classes in this unit. It is 1 for classes without a row.

    Examples
    --------
    >>> units_m([1, 3, 7], ((1, "pedestrian"), (3, "car")))
    [1.0, 4.0, 1.0]
    """
    by_class = limits_by_class(numbers, names, class_limits)
    person = LIMITS["person"].speed_m_per_s
    return [1.0 if (row := by_class[number]).name == UNKNOWN else row.speed_m_per_s / person for number in numbers]


#: What a text of ``read_limits`` can set, in this order.
_NUMBERS: Final = ("speed", "drift", "noise", "gate")


def read_limits(text: str) -> dict[str, MotionLimits]:
    """The limits of classes in a text of the form NAME=SPEED:DRIFT:NOISE:GATE, with commas between several.

    SPEED is the most in metres per second, DRIFT how much a velocity changes within a second, NOISE and GATE are in
    metres. Those at the end may be left out, and any may be empty: they stay as in the table.

    Raises McaptrackError if a text has another form, names a class twice, or has a SPEED, NOISE or GATE of 0.

    Examples
    --------
    >>> read_limits("car=40, forklift=6::0.1")["forklift"].noise_m
    0.1
    """
    out: dict[str, MotionLimits] = {}
    for entry in filter(str.strip, text.split(",")):
        name, equals, values = entry.partition("=")
        name, parts = name.strip().lower(), [part.strip() for part in values.split(":")]
        try:
            numbers: list[float | None] = [float(part) if part else None for part in parts]
        except ValueError:
            numbers = []
        is_good = all(number is None or 0 <= number < 1e6 for number in numbers)
        if not (name and equals and any(parts) and numbers and is_good and len(numbers) <= len(_NUMBERS)):
            raise McaptrackError(
                f"class_limits has {entry.strip()!r}; it is NAME=SPEED:DRIFT:NOISE:GATE in m/s, m/s within a second, m "
                "and m, as in car=40 or pedestrian=4:0.5:0.1:1.2"
            )
        row = limits_of(name)
        missing: list[float | None] = [None] * (len(_NUMBERS) - len(numbers))
        speed, drift, noise, gate = numbers + missing
        if 0 in (speed, noise, gate):
            raise McaptrackError(f"class_limits has {entry.strip()!r}; SPEED, NOISE and GATE have to be more than 0")
        if name in out:
            raise McaptrackError(f"class_limits names {name} twice; give each class once")
        most = row.max_speed_m_per_s if speed is None else speed
        out[name] = row._replace(
            name=row.name if row.name != UNKNOWN else name,
            max_speed_m_per_s=most,
            speed_m_per_s=min(row.speed_m_per_s, most),
            drift_m_per_s=row.drift_m_per_s if drift is None else drift,
            noise_m=row.noise_m if noise is None else noise,
            gate_m=row.gate_m if gate is None else gate,
        )
    return out
