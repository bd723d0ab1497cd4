"""Numbers and names as words that a reader can trust."""

from collections.abc import Sequence

NAMES = {
    "retinanet": "RetinaNet",
    "faster_rcnn": "Faster R-CNN",
    "yolov5": "YOLOv5",
    "fcos": "FCOS",
    "mean": "mean",
}
_RENDERERS = {"torch": "differentiable renderer", "cycles": "Blender Cycles"}
_THIN = "\u202f"
_NAMED = 2


def detector_name(name: str) -> str:
    """The detector's usual spelling."""
    return NAMES.get(name, name)


def body_name(name: str) -> str:
    """A body type's id as words."""
    return name.replace("_", " ")


def renderer_name(name: str) -> str:
    """A renderer in words."""
    return _RENDERERS.get(name, name)


def listed(words: Sequence[str]) -> str:
    """Words as a list in a sentence: "a, b and c"; "nothing" for none."""
    if not words:
        return "nothing"
    *before, last = words
    return f"{', '.join(before)} and {last}" if before else last


def counted(count: int, noun: str, several: str = "") -> str:
    """A number with its noun: "1 image", "1,200 images"."""
    return f"{count:,} {noun if count == 1 else several or f'{noun}s'}"


def named(names: Sequence[str], noun: str) -> str:
    """The number of things with some of their names: "12 images (a.jpg, b.jpg and 10 more)"."""
    if len(names) == 1:
        return names[0]
    rest = len(names) - _NAMED
    shown = names if rest <= 1 else [*names[:_NAMED], f"{rest:,} more"]
    return f"{counted(len(names), noun)} ({listed(shown)})"


def span(low: float, high: float, digits: int = 0) -> str:
    """A range, "24 to 34"; one number where both are written alike."""
    first, last = f"{low:.{digits}f}", f"{high:.{digits}f}"
    return first if first == last else f"{first} to {last}"


def percent(fraction: float | int | None, digits: int = 0) -> str:
    """A fraction as a percentage; a dash where undefined. Never a rounded "-0"."""
    if fraction is None or fraction != fraction:
        return "–"
    text = f"{100 * fraction:.{digits}f}"
    return (text.lstrip("-") if float(text) == 0 else text.replace("-", "−")) + f"{_THIN}%"


def hides(share: float | int | None) -> str:
    """What a camouflage does to vehicles, by the share that it hides: "hides 48 %".

    Below zero: "is found 53 % more often".
    """
    shown = percent(share)
    return f"is found {shown[1:]} more often" if shown.startswith("−") else f"hides {shown}"


def interval(low: float | int | None, high: float | int | None) -> str:
    """An interval of fractions, "79 to 88 %"; a dash where undefined."""
    if low is None or high is None or low != low:
        return "–"
    return f"{percent(low).removesuffix(_THIN + '%')} to {percent(high)}"


def points(fraction: float | None, digits: int = 0) -> str:
    """A difference of two rates in percentage points, with its sign; a dash where undefined."""
    if fraction is None or fraction != fraction:
        return "–"
    text = f"{100 * fraction:+.{digits}f}"
    return "0" if float(text) == 0 else text.replace("-", "−")


def number(value: float | int | None, digits: int = 0) -> str:
    """A number with thousands separators; a dash where undefined."""
    return "–" if value is None or value != value else f"{value:,.{digits}f}".replace(",", _THIN)


def probability(value: float | int | None) -> str:
    """A p-value to one useful digit."""
    if value is None:
        return "–"
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def evidence(value: float) -> str:
    """Evidence, a factor from 0 on, to the digits that matter."""
    if value >= 1000:
        return f"> 1{_THIN}000"
    return "< 0.1" if value < 0.1 else f"{value:.{0 if value >= 10 else 1}f}"
