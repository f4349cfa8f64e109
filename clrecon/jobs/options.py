"""Settings that every job shares: which scan, which parts of it become air, and which device; without numpy."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from clrecon.errors import UsageError
from clrecon.jobs.cluster import check_address
from clrecon.jobs.presets import DEFAULT_PRESET, PRESETS
from clrecon.reading import Selection
from clrecon.reading.common.selection import series_option as series_option
from clrecon.system.arguments import name_parameter
from clrecon.system.light_dataclass import dataclass, fields
from clrecon.system.options import numbers_reader, option, parse_numbers
from clrecon.system.text import escape_text

if TYPE_CHECKING:
    from clrecon.geometry.blocks import Box


REGION_FORMS = "box:X0,X1,Y0,Y1,Z0,Z1, hu:LO,HI, label:FILE:NAME, mask:FILE, seed:X,Y,Z, tube:MM and tube:MM:FILE"

PREPROCESS_FORMS = (
    "bilateral[:MM[:HU]], bilateral-2d[:MM[:HU]], bilateral-near[:MM[:HU]], median[:MM], gaussian[:MM],"
    " curvature-flow[:N], non-local-means[:HU], level:HU, erode:MM, dilate:MM, open:MM, close:MM, fill, fill-slices"
    " and region"
)


parse_point = numbers_reader(3, "is no point: three numbers in mm with commas, X,Y,Z")

LEVELS_HELP = (
    "iso value in HU, inside is N and above; A:B is a range, inside is from A to B; several with commas make one mesh"
    " each;"
    " auto: half way between bone and the tissue beside it, measured in the scan;"
    " half:BONE,TISSUE: half way between these two"
)
_HALF = "half:"


def parse_hu(text: str) -> dict[str, Any]:
    """Read numbers, ranges, ``auto`` or ``half:BONE,TISSUE`` as the fields `iso_value` or `half_way` of settings."""
    if text == "auto":
        return {"half_way": "auto"}
    if not text.startswith(_HALF):
        return {"iso_value": tuple(_parse_level(part, text) for part in text.split(","))}
    materials = parse_levels(text.removeprefix(_HALF))
    if len(materials) != 2:
        raise ValueError(f"{text!r} does not name two materials in HU, as half:1200,40 does")
    return {"half_way": materials}


def _parse_level(part: str, text: str) -> float | tuple[float, float]:
    """Read a number, or the two ends of a range A:B."""
    if ":" not in part:
        return parse_levels(part, text)[0]
    ends = part.split(":")
    if len(ends) != 2 or not all(ends):
        context = f" in {text!r}" if part != text else ""
        raise ValueError(
            f"{part!r}{context} is no range A:B of two numbers of HU; from A on is {name_parameter('iso_value', 'A')},"
            f" below B is {name_parameter('below', 'B')}"
        )
    low, high = (parse_levels(end, text)[0] for end in ends)
    return low, high


def parse_levels(text: str, whole: str | None = None) -> tuple[float, ...]:
    """Read one number, or several with commas between them; `whole` is the full text of which `text` is a part."""
    levels = []
    for part in text.split(","):
        try:
            levels.append(float(part))
        except ValueError:
            context = f" in {whole or text!r}" if part != (whole or text) else ""
            raise ValueError(f"{part!r}{context} is no number of HU") from None
    return tuple(levels)


def parse_label_color(text: str) -> tuple[str, str]:
    label, _, color = text.rpartition("=")
    if not label or not color:
        raise ValueError(f"{text!r} is not LABEL=COLOUR, such as L2=red or 20=#ff8000")
    return label, color


def _parse_radius(text: str) -> float | str:
    try:
        return text if text == "auto" else float(text)
    except ValueError:
        raise ValueError(f"{text!r} is no radius in mm") from None


_SIZE = re.compile(r"([0-9]+(?:\.[0-9]*)?) *([kmgt]?)(i?)b?", re.IGNORECASE)

_MOST_MEMORY = 2.0**63


def parse_bytes(text: str) -> int:
    """Read an amount of memory: a number with B, kB, MB, GB (powers of 1000), KiB, MiB or GiB (of 1024)."""
    match = _SIZE.fullmatch(text.strip())
    if match is None or (match[3] and not match[2]):
        raise ValueError(f"{text!r} is no amount of memory: write it as 500MB or 2GiB")
    size = float(match[1]) * (1024 if match[3] else 1000) ** " kmgt".index(match[2].lower() or " ")
    if size >= _MOST_MEMORY:
        raise ValueError(f"{text!r} is more memory than there can be: write it as 500MB or 2GiB")
    return int(size)


_masking_option = partial(option, group="masking")
_crop_option = partial(option, group="crop")


ALL_DEVICES = "all"
"""In place of a device: all usable ones of the machine, for jobs that are shared out."""


@dataclass(frozen=True, kw_only=True)
class DeviceSettings:
    device: str | None = option(
        "--device D",
        'OpenCL device: an index of "clrecon devices", "cpu", "gpu" or a part of its name'
        " (default: CLRECON_DEVICE, otherwise the best)",
        group="device",
        first=True,
        words=("cpu", "gpu"),
    )
    memory: int | None = option(
        "--memory SIZE",
        "limit the memory that is used on the device, such as 500MB or 2GiB (default: all of it);"
        " what does not fit is processed in slabs, with the same result",
        group="memory",
        parse=parse_bytes,
    )

    def __post_init__(self) -> None:
        if self.memory is not None and self.memory < 1:
            raise UsageError(f"the memory that may be taken must be above 0 bytes, not {self.memory}")


@dataclass(frozen=True, kw_only=True)
class ScanSettings(Selection):
    """The part of a scan that is read, and what of its origin is written."""

    keep_ids: bool = option(
        "--keep-ids",
        "write hashes of the UIDs of series and frame of reference, which identify outputs of the same scan; never"
        " the UIDs",
        group="ids",
    )


def changed_fields(settings: InputSettings) -> list[str]:
    """Return the names of the fields that are not their defaults; an empty list is as good as an empty tuple."""
    values = [(own.name, getattr(settings, own.name), own.default) for own in fields(settings)]
    return [name for name, value, default in values if value != default and value not in ((), [])]


def label_map_option(**how: Any) -> Any:
    return option(
        "--labels FILE|FOLDER",
        "label map: NIfTI, NRRD (.seg.nrrd too), MetaImage, DICOM SEG, RTSTRUCT, or a folder of masks",
        first=True,
        **how,
    )


def label_option(text: str = "use only this label; may be given again", **how: Any) -> Any:
    """Declare a field for chosen labels of a map, with ``action=None`` for one."""
    return option("--label NAME|N", text, **{"action": "append"} | how)


def hu_option(text: str, values: str = "N", **how: Any) -> Any:
    """Declare a field for a level of HU; `values` says what stands for it."""
    return option(f"--hu {values}", text, **how)


def seeds_option(text: str, **how: Any) -> Any:
    return option("--seed X,Y,Z", text, default=(), parse=parse_point, action="append", **how)


def scheduler_option(text: str, **how: Any) -> Any:
    return option("--scheduler ADDRESS", text, parse=check_address, **how)


def refuse_changed(settings: Any, names: Sequence[str], reason: str) -> None:
    """Refuse settings that are not their defaults, for a `reason`."""
    defaults = {field.name: field.default for field in fields(settings)}
    given = [name_parameter(name) for name in names if getattr(settings, name) not in (defaults[name], [])]
    if given:
        raise UsageError(f"{reason}: leave out {' and '.join(given)}")


def describe_sharing(scheduler: str | None) -> str:
    """Say why surfaces that are made in one piece are refused where they are shared out."""
    asked = name_parameter("device", ALL_DEVICES) if scheduler is None else name_parameter("scheduler", scheduler)
    return f"{asked} shares out plain surfaces"


def view_option(values: str, text: str, **how: Any) -> Any:
    """Declare a field for where the camera stands; `values` says what stands for it."""
    return option(f"--view {values}", text, **how)


def strict_option(text: str, **how: Any) -> Any:
    """Declare a field for an exit code by failed gates."""
    return option("--strict", f"exit with {text}", **how)


def grow_option(when: str = "", **how: Any) -> Any:
    text = f"{when}add dense voxels within this distance of a label to it (default: one voxel each way)"
    return option("--grow MM", text, **how)


def space_option(text: str, **how: Any) -> Any:
    """Declare a field for the patient frame of what is written."""
    return option("--space lps|ras", f"{text} (default: lps)", default="lps", parse=str.lower, **how)


def check_space(space: str | None) -> None:
    """Refuse an unknown patient frame; None is not given."""
    from clrecon.geometry.affine import frame_from_lps  # numpy: not loaded before a job starts

    if space is not None:
        frame_from_lps(space)


def preset_option(text: str, **how: Any) -> Any:
    return option("--preset NAME", text, parse=str.lower, **how)


def iso_preset_option() -> Any:
    text = f"iso value by tissue, one of: {', '.join(PRESETS)} (default: {DEFAULT_PRESET})"
    return preset_option(text, group="level", words=PRESETS)


def surface_option(of_hu: str, more: str = "", **how: Any) -> Any:
    """Declare a field for the kind of a surface of bone; `more` is one beside ``hu`` and ``cortex``, with its text."""
    words = ("hu", "cortex", *(more.split(":")[:1] if more else ()))
    return option(
        f"--surface {'|'.join(words)}",
        f"hu: {of_hu}; cortex: each vertex is moved onto the bone surface, found from the HU profile across the wall"
        f" (docs/iso_value.md){f'; {more}' if more else ''}",
        parse=str.lower,
        words=words,
        **how,
    )


def check_surface(surface: str | None, level: float | None = None, *more: str) -> None:
    words = ("hu", "cortex", *more)
    if surface is not None and surface not in words:
        raise UsageError(f"there is no surface {surface!r}: it is {', '.join(words[:-1])} or {words[-1]}")
    if level is not None and not math.isfinite(level):
        raise UsageError(f"the level is a finite number of HU, not {level}")


def closed_option() -> Any:
    """Declare a field for surfaces that are closed where they meet the border of the volume: outside is air."""
    return option("--open", "leave the surface open at the border of the volume", group="surface", default=True)


def mesh_space_option(text: str, group: str = "") -> Any:
    text = f"patient frame of {text} (default: lps, with a warning)"
    return option("--mesh-space lps|ras", text, group=group, parse=str.lower)


def _parse_size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else (*parts, *parts)))
    except ValueError:
        raise ValueError(f"{text!r} is no size in pixels: write it as 1024 or 1024x768") from None
    return width, height


def size_option(**how: Any) -> Any:
    width, height = how.get("default") or (1024, 1024)
    return option("--size W[xH]", f"pixels of the picture (default: {width}x{height})", parse=_parse_size, **how)


def label_color_option(text: str) -> Any:
    text = f"set the colour of a label{text}; may be given again"
    return option("--label-color LABEL=COLOUR", text, default=(), parse=parse_label_color, action="append")


@dataclass(frozen=True, kw_only=True)
class InputSettings(ScanSettings, DeviceSettings):
    """Settings of the input: what is read, which parts become air, and the device; see the help of the options.

    field_of_view: float or "auto". mm from the centre of the slices.
    clip_box, between, around, region: mm of the frame `space` where the job has one, else LPS; infinite numbers leave a
        side open.
    """

    remove_table: bool = _masking_option(
        "--remove-table", "set everything outside the patient's body to air first: table, blankets, cables", first=True
    )
    allow_bone_loss: bool = _masking_option(
        "--allow-bone-loss",
        "continue if --remove-table removes more than 2 %% of the bone, or a step of --preprocess more than half of"
        " what is at the level and above; otherwise both are refused",
    )
    field_of_view: float | str | None = _masking_option(
        "--fov RADIUS_MM",
        "set everything farther from the centre of the slices to air first (without a number: outside the largest"
        " circle that fits the slice)",
        parse=_parse_radius,
        nargs="?",
        const="auto",
    )
    clip_box: Sequence[float] | None = _crop_option(
        "--clip-box X0,X1,Y0,Y1,Z0,Z1",
        "keep a box; an empty side is open",
        parse=numbers_reader(
            6, "is no box: X0,X1,Y0,Y1,Z0,Z1 in mm, a side that stays open empty, such as ,,-50,20,,", ends=True
        ),
    )
    between: Sequence[float] | None = _crop_option(
        "--between Z0,Z1",
        "keep what lies between two heights",
        parse=numbers_reader(
            2, "are no two heights: Z0,Z1 in mm, one of them may be empty, such as -450,-400", ends=True
        ),
    )
    around: Sequence[float] | None = _crop_option(
        "--around X,Y,Z,R",
        "keep a cube that extends R mm from a point to each side",
        parse=numbers_reader(4, "is no point and length: X,Y,Z,R in mm, such as 10,-124,-424,30"),
    )
    region: Sequence[str] | None = _masking_option(
        "--region RULE",
        f"set everything outside the region of interest to air first: {REGION_FORMS}; rules of one kind are united,"
        " of different kinds intersected; a seed grows within the others; a tube without a file follows the spinal"
        " canal",
        action="append",
    )
    preprocess: str | Sequence[str] | None = _masking_option(
        "--preprocess STEP[,STEP...]",
        f"run these steps before the surface, in the given order: {PREPROCESS_FORMS}; morphology works on voxels at the"
        " iso value and above, or at level:HU; region is the place of --region, which otherwise runs first",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.field_of_view, str):
            if self.field_of_view != "auto":
                raise UsageError(f"the field of view is a radius in mm or auto, not {self.field_of_view!r}")
        elif self.field_of_view is not None and not (math.isfinite(self.field_of_view) and self.field_of_view > 0.0):
            raise UsageError(f"the radius of the field of view is a length in mm above 0, not {self.field_of_view:g}")
        if self.allow_bone_loss and not (self.remove_table or self.preprocess is not None):
            raise UsageError(
                "a loss of bone is allowed, but nothing takes any: ask for the removal of the table or for"
                " preprocessing too"
            )
        _ = self.crop
        if self.region:
            parse_region_rules(self.region)
        if self.region_later and not self.region:
            raise UsageError("a step of preprocessing is the region of interest, and there is none: give its rules")

    @property
    def crop(self) -> Box | None:
        from clrecon.geometry.blocks import crop_box  # loads numpy, which the help does without

        return crop_box(self.clip_box, self.between, self.around)

    @property
    def crop_margin(self) -> int:
        """Voxels that stay beyond the box on each side."""
        return 0

    @property
    def region_later(self) -> bool:
        """True where the region of interest is a step of preprocessing, and does not come before."""

        return self.preprocess is not None and any(step.name == "region" for step in parse_preprocess(self.preprocess))

    @property
    def space_of_points(self) -> str:
        """Patient frame of the region's numbers: that of what is written, LPS where a job has none."""
        return str(getattr(self, "space", "lps"))


@dataclass(frozen=True, kw_only=True)
class SharedSettings(InputSettings):
    """Settings of jobs whose work can be shared out to all devices of this machine."""

    @property
    def uses_all_devices(self) -> bool:
        return self.device == ALL_DEVICES

    @property
    def main_device(self) -> str | None:
        """The device of all that is not shared out."""
        return None if self.uses_all_devices else self.device


_REGION_NUMBERS = {"box": 6, "hu": 2, "seed": 3, "tube": 1}


@dataclass(frozen=True)
class RegionRule:
    """One rule.

    kind: {"box", "hu", "label", "mask", "seed", "tube"}
    numbers: mm or HU: of a box (x0, x1, y0, y1, z0, z1), infinite where a side is open; of HU the lowest and the
        highest; of a seed a point; of a tube its radius.
    path: Label map, or file of a centre line; a tube without one goes along the spinal canal.
    name: Label in the map.
    """

    kind: str
    numbers: tuple[float, ...] = ()
    path: str | None = None
    name: str | None = None

    def __str__(self) -> str:
        numbers = ",".join("" if math.isinf(number) else f"{number:g}" for number in self.numbers)
        file = None if self.path is None else escape_text(self.path.replace("\\", "/").rsplit("/", 1)[-1])
        return ":".join(part for part in (self.kind, numbers, file, self.name) if part)


def parse_region_rules(rules: str | Sequence[str]) -> tuple[RegionRule, ...]:
    """Read region rules, of the forms `REGION_FORMS`."""
    parsed = tuple(_parse_region_rule(str(rule).strip()) for rule in ([rules] if isinstance(rules, str) else rules))
    kinds = {rule.kind for rule in parsed}
    if "seed" in kinds and not kinds & {"hu", "label", "mask"}:
        raise UsageError(
            "a region's seed grows within HU or labels: give a rule hu:LO,HI, label:FILE:NAME or mask:FILE too"
        )
    return parsed


def _parse_region_rule(rule: str) -> RegionRule:
    kind, _, rest = rule.partition(":")
    kind = kind.lower()
    numbers: tuple[float, ...] | None = ()
    path = name = ""
    if kind == "label":
        path, _, name = rest.rpartition(":")
        is_known = bool(path and name.strip())
    elif kind == "mask":
        path = rest
        is_known = bool(path)
    else:
        words, _, path = rest.partition(":") if kind == "tube" else (rest, "", "")
        numbers = parse_numbers(words, ends=kind in ("box", "hu"))
        is_known = numbers is not None and len(numbers) == _REGION_NUMBERS.get(kind)
    if numbers is None or not is_known:
        raise UsageError(f"the region rule {rule!r:.200} is not known: the rules are {REGION_FORMS}")
    _check_region_numbers(rule, kind, numbers)
    return RegionRule(kind, numbers, path or None, name.strip() or None)


def locate_region_rule(rule: str, folder: str) -> str:
    """Return a region rule whose file is named by its full path, which starts at `folder`."""
    parsed = _parse_region_rule(rule.strip())
    if parsed.path is None:
        return rule
    parts = (parsed.kind, *parsed.numbers, os.path.join(folder, parsed.path), parsed.name)
    return ":".join(str(part) for part in parts if part is not None)


def _check_region_numbers(rule: str, kind: str, numbers: tuple[float, ...]) -> None:
    has_ends = kind in ("box", "hu")
    if any(math.isnan(number) or (math.isinf(number) and not has_ends) for number in numbers):
        raise UsageError(f"the region rule {rule!r:.200} needs finite numbers")
    for low, high in zip(numbers[::2], numbers[1::2], strict=True) if has_ends else ():
        if low > high or (kind == "box" and low == high):
            raise UsageError(
                f"the region rule {rule!r:.200} holds nothing: give the lower end first, {high:g} is not above {low:g}"
            )
    if kind == "tube" and not numbers[0] > 0.0:
        raise UsageError(f"the radius of a tube is a length in mm above 0, not {numbers[0]:g} ({rule!r:.200})")


FILTERS = {
    "bilateral": ("sigma_mm", "sigma_hu"),
    "bilateral-2d": ("sigma_mm", "sigma_hu"),
    "bilateral-near": ("sigma_mm", "sigma_hu"),
    "median": ("radius_mm",),
    "gaussian": ("sigma_mm",),
    "curvature-flow": ("iterations",),
    "non-local-means": ("sigma_hu",),
}
"""Filters of HU, with the parameters that may follow them."""

COUNTED = ("curvature-flow",)
"""Filters whose parameter is a whole number."""

MORPHOLOGY = ("erode", "dilate", "open", "close", "fill", "fill-slices")
"""Steps on the voxels at the level and above."""

_WITH_RADIUS = ("erode", "dilate", "open", "close")


@dataclass(frozen=True)
class PreprocessStep:
    """One step: its name and the numbers behind it, in the order of `FILTERS`; a radius in mm, a level in HU."""

    name: str
    numbers: tuple[float, ...] = ()

    def __str__(self) -> str:
        return ":".join((self.name, *(f"{number:g}" for number in self.numbers)))


def parse_preprocess(steps: str | Sequence[str]) -> tuple[PreprocessStep, ...]:
    """Read the steps of preprocessing, of the forms `PREPROCESS_FORMS`; they run in this order.

    Morphology, by a ball with a radius in mm, works on all voxels at the level of the job and above, or of ``level:HU``
    if that stands before; ``region`` is the place of the region of interest, which else comes first.
    """
    words = steps.split(",") if isinstance(steps, str) else [str(step) for step in steps]
    parsed = tuple(_parse_step(word.strip()) for word in words)
    if sum(step.name == "region" for step in parsed) > 1:
        raise UsageError("the region of interest has one place among the steps of preprocessing, it is named twice")
    return parsed


def _parse_step(word: str) -> PreprocessStep:
    name, *rest = word.lower().split(":")
    try:
        numbers = tuple(float(number) for number in rest)
    except ValueError:
        numbers = (math.nan,)
    most = len(FILTERS[name]) if name in FILTERS else int(name in (*_WITH_RADIUS, "level"))
    least = 0 if name in FILTERS else most
    known = name in FILTERS or name in MORPHOLOGY or name in ("level", "region")
    if not known or not least <= len(numbers) <= most or not all(map(math.isfinite, numbers)):
        raise UsageError(f"the step {word!r:.80} of preprocessing is not known: the steps are {PREPROCESS_FORMS}")
    if name != "level" and any(number <= 0.0 for number in numbers):
        raise UsageError(f"the step {word!r:.80} of preprocessing needs numbers above 0")
    if name in COUNTED:
        if any(number != int(number) for number in numbers):
            raise UsageError(f"the step {word!r:.80} of preprocessing needs a whole number")
        numbers = tuple(int(number) for number in numbers)
    return PreprocessStep(name, numbers)
