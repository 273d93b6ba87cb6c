"""Words and numbers as a roboticist says them: millimetres, degrees, milliseconds, grams, with the digits
that are known."""

from __future__ import annotations

import inspect
import math
import re

from fastrod.effects.base import get_effect, trait
from fastrod.identification.search.model_selection import DetectionLimit
from fastrod.identification.search.motion import DAMPING, INERTIA, KelvinVoigtDamping, RodInertia
from fastrod.identification.search.structure import NAME as ONE_SIDED
from fastrod.identification.search.structure import OneSidedTendons

NOTHING = "–"
VERDICTS = {
    "none": "Nothing is missing",
    "explained": "Explained",
    "partly_explained": "Partly explained",
    "ambiguous": "Explained, up to a class",
    "not_in_library": "Not in the library",
}
_NOUNS = {
    "line_density": "self-weight",
    "cubic": "cubic term",
    "radial": "radial term",
    "per_bend": "shortening",
    "ratio": "difference",
    "from_distal": "share of the neighbour",
    "from_proximal": "share of the neighbour",
}

_SCALES: dict[str, tuple[tuple[float, float, str], ...]] = {
    # SI unit: (least size, factor, unit), the largest first
    "m": ((1e-5, 1e3, "mm"), (0.0, 1e6, "µm")),
    "rad": ((0.0, 180.0 / math.pi, "°"),),
    "s": ((2.0, 1.0, "s"), (0.0, 1e3, "ms")),
    "kg": ((2.0, 1.0, "kg"), (0.0, 1e3, "g")),
    "kg/m": ((10.0, 1.0, "kg/m"), (0.0, 1e3, "g/m")),
    "N": ((0.1, 1.0, "N"), (0.0, 1e3, "mN")),
    "m/N": ((1e-5, 1e3, "mm/N"), (0.0, 1e6, "µm/N")),
    "m/s": ((1e-3, 1e3, "mm/s"), (0.0, 6e4, "mm/min")),
    "N m^2": ((0.0, 1e6, "N mm²"),),
    "1/m": ((0.0, 1.0, "1/m"),),
    "1/rad": ((0.0, 100.0, "%/rad"),),
    "1/rad^2": ((0.0, 100.0, "%/rad²"),),
    "x nominal": ((0.0, 1.0, "× nominal"),),
    "": ((0.0, 100.0, "%"),),
}


BASE_MODELS: dict[str, type] = {ONE_SIDED: OneSidedTendons, INERTIA: RodInertia, DAMPING: KelvinVoigtDamping}
"""Base models that lack more than effects, by name."""


def friendly(unit: str, size: float) -> tuple[float, str]:
    """The factor from the SI `unit` to the one in which a number of about `size` is said, and that unit."""
    scales = _SCALES.get(unit, ((0.0, 1.0, unit),))
    return next(
        (factor, name) for least, factor, name in scales if not math.isfinite(size) or abs(size) >= least
    )


def amount(value: float, unit: str, digits: int = 2) -> str:
    """A size, as in '4.8 g'; – where there is none."""
    if not math.isfinite(value):
        return NOTHING
    factor, name = friendly(unit, value)
    return _joined(rounded(value * factor, digits), name)


def estimate(value: float, stderr: float, unit: str) -> tuple[str, str, str]:
    """A fitted number and its standard error with the digits that are known, and their unit; – for what is
    not there."""
    factor, name = friendly(unit, value or stderr)
    if not math.isfinite(value):
        return NOTHING, NOTHING, name
    if not (math.isfinite(stderr) and stderr > 0.0):
        return rounded(value * factor, 3), NOTHING, name
    places = _places(stderr * factor, 2)
    if places > _places(value * factor, 5):  # an error far below the number: five digits are enough
        places = _places(value * factor, 5) if value else places
    return _fixed(value * factor, places), rounded(stderr * factor, 2), name


def with_error(value: float, stderr: float, unit: str) -> str:
    """'0.343 ± 0.003 mm'."""
    number, error, name = estimate(value, stderr, unit)
    return _joined(number if error == NOTHING else f"{number} ± {error}", name)


def millimetres(metres: float, digits: int = 3) -> str:
    """A length [m] in mm, without its unit."""
    return rounded(1e3 * metres, digits) if math.isfinite(metres) else NOTHING


def percent(fraction: float) -> str:
    """A share of one, never rounded up to all of it."""
    if not math.isfinite(fraction):
        return NOTHING
    if 0.99 < fraction < 1.0:
        return "over 99 %"
    return (
        f"{100 * fraction:.0f} %" if abs(fraction) >= 0.0995 or fraction == 0.0 else f"{100 * fraction:.1f} %"
    )


def rounded(value: float, digits: int) -> str:
    """`digits` significant ones, without an exponent: 0.00038, 4.8, 1200."""
    return _fixed(value, _places(value, digits)) if value else "0"


def words(name: str) -> str:
    """`tendon_stretch` as 'tendon stretch'."""
    return "tendons that can only pull" if name == ONE_SIDED else name.replace("_", " ")


def a(noun: str) -> str:
    """The noun with its article."""
    return f"{'an' if noun[:1].lower() in 'aeiox' else 'a'} {noun}"


def plain_name(name: str) -> str:
    """`segment.*.bending_stiffness` as 'bending stiffness, all segments'."""
    owner, _, rest = name.partition(".")
    if owner.startswith("session ") and rest:
        return f"{plain_name(rest)}, {owner}"
    number, _, what = rest.partition(".")
    if owner in ("segment", "tendon") and what:
        return f"{words(what)}, {'all ' + owner + 's' if number == '*' else f'{owner} {number}'}"
    return words(name.replace(".", ", "))


def law(name: str) -> dict[str, str]:
    """Equation, Symbols, Source and Residual signature of an effect, or of other tendons, from its
    docstring."""
    what = BASE_MODELS.get(name) or type(get_effect(name))
    text = inspect.cleandoc(what.__doc__ or "")
    keys = "Equation|Symbols|Source|Residual signature"
    found = re.findall(rf"^({keys}): (.*(?:\n(?!\n|\w[\w ]*: ).*)*)", text, flags=re.MULTILINE)
    return {key: " ".join(value.split()) for key, value in found}


def bound_sentence(bound: DetectionLimit) -> str:
    """Return the sentence on the smallest size at which an effect would have shown."""
    stem = re.sub(r"_([xyz]|\d+)$", "", bound.parameter)
    noun = _NOUNS.get(
        stem, f"component along {stem}" if len(stem) == 1 else "size" if stem == "size" else words(stem)
    )
    if not math.isfinite(bound.value):
        needs = str(trait(get_effect(bound.name), "excited_by"))
        return f"this log cannot show {words(bound.name)}" + (f"; it takes {needs}" if needs else "")
    return f"{words(bound.name)}: {a(noun)} above {amount(bound.value, bound.unit)} would have shown"


def _joined(number: str, unit: str) -> str:
    return f"{number}{'' if unit == '°' else ' '}{unit}".rstrip()


def _places(value: float, digits: int) -> int:
    """Decimal places that leave so many significant digits."""
    return digits - 1 - math.floor(math.log10(abs(value))) if value else 0


def _fixed(value: float, places: int) -> str:
    text = f"{round(value, places):.{max(places, 0)}f}"
    return text.replace("-", "−")
