"""Read thermal files as cameras write them: degrees, counts, and radiometric JPEGs.

A radiometric JPEG shows a picture in the colours of a palette, and holds the measurement beside it.
"""

from __future__ import annotations

import importlib.util
import io
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray
from PIL import Image
from PIL.ExifTags import Base

from rgbt.checks import InputError, one_line
from rgbt.data.files import LEFT_OUT, UNREADABLE, decode, read_array, read_bytes
from rgbt.files.atomic import write_atomic
from rgbt.ranges import Text

Level = Annotated[float, Interval(ge=-1e6, le=1e6)]
Range = tuple[Level, Level]
Auto = Literal["auto"]
# [low, high] or auto, in stored values; or a mapping of `unit` and `range`, in degrees Celsius.
ThermalRange = Range | Text | dict[Text, Text | Range]

# `auto`: what of the values is darker than black, and as much brighter than white; and of how many
# training images, which are enough for percentiles and take a few seconds.
TAIL, MOST_IMAGES = 0.005, 200
# Values of an image that stand for all, from the smallest to the largest, equally spaced by rank.
POINTS = 201
# Degrees Celsius between which the median of an image of a scene lies; in another unit it does not.
PLAUSIBLE = (-90.0, 200.0)

# Beginning of an APP4 segment of DJI's R-JPEG, and of the APP1 segments of FLIR.
DJI, FLIR = b"\xff\xd2\xd1\xff", b"FLIR\0"


@dataclass(frozen=True)
class Unit:
    """Says what stored values v are: gain * v + offset degrees Celsius; `name`: "" for own ones."""

    name: str
    gain: float
    offset: float

    def degrees(self, values: Any) -> Any:
        """Return degrees Celsius of stored values."""
        return self.gain * values + self.offset

    def stored(self, limits: Range) -> Range:
        """Return the stored values of (low, high) degrees Celsius."""
        low, high = ((limit - self.offset) / self.gain for limit in limits)
        return low, high


UNITS = {
    "celsius": Unit("celsius", 1.0, 0.0),
    "kelvin": Unit("kelvin", 1.0, -273.15),
    "centikelvin": Unit("centikelvin", 0.01, -273.15),
}


def unit_and_limits(setting: ThermalRange | None) -> tuple[Unit | None, Range | Auto | None]:
    """Return the unit of stored values, None without one, and the limits, of a `thermal_range`.

    InputError: `unit` or `range` are missing or exchanged, a gain or a range that does not rise.
    """
    unit: Unit | None = None
    limits: Any = setting
    if isinstance(setting, Mapping):
        given: Any = setting.get("unit")
        limits = setting.get("range")
        is_own = isinstance(given, tuple) and given[0] > 0
        unit = Unit("", *given) if is_own else UNITS.get(given)
    is_known = isinstance(limits, tuple) or limits == "auto"
    if isinstance(setting, Mapping) and not (unit and is_known and len(setting) == 2):
        raise InputError(
            "dataset.thermal_range: expected {unit: U, range: R}, where U is "
            f"{', '.join(UNITS)} or [gain, offset] with a gain above 0, and R is [low, high] "
            f"in degrees Celsius or auto; got {dict(setting)}."
        )
    if not is_known and limits is not None:
        raise InputError(f"dataset.thermal_range: expected [low, high] or auto, got {limits}.")
    if isinstance(limits, tuple) and not limits[0] < limits[1]:
        raise InputError(
            f"dataset.thermal_range: expected [low, high], got {list(limits)}: the thermal "
            "values that become black and white."
        )
    return unit, limits


def read_thermal(path: Path, unit: Unit | None) -> NDArray[Any]:
    """Read stored values as written, (H, W) or (H, W, C); of a radiometric JPEG degrees Celsius.

    InputError: missing or damaged; a radiometric JPEG that is not read, or without its unit.
    """
    if path.suffix.lower() == ".npy":
        return read_array(path, "numbers")
    maker = maker_of(path)
    if maker is None:
        return decode(path)
    what = f"{path} is a radiometric JPEG of {maker}, whose pixels are no temperatures"
    if maker == "DJI":
        raise InputError(
            f"{what}; convert it with the program dji-thermal-cli (output temp_c:tiff), and read "
            "the TIFF with dataset.thermal_range={unit: celsius, range: auto}."
        )
    if importlib.util.find_spec("flyr") is None:
        raise InputError(f"{what}; reading these requires flyr: pip install 'rgbt[thermal]'.")
    if unit != UNITS["celsius"]:
        raise InputError(f"{what}; set dataset.thermal_range={{unit: celsius, range: auto}}.")
    return read_flir(path)[0]


def maker_of(path: Path) -> Literal["FLIR", "DJI"] | None:
    """Return who wrote a radiometric JPEG; None for other files, also for unreadable ones."""
    if not path.is_file():  # a pipe would be waited for
        return None
    try:
        with path.open("rb") as file:
            if file.read(2) != b"\xff\xd8":
                return None
            file.seek(0)
            with Image.open(file, formats=("JPEG",)) as image:
                segments: list[tuple[str, bytes]] = image.applist  # type: ignore[attr-defined]
                make = str(image.getexif().get(Base.Make, ""))
    except UNREADABLE:
        return None  # decoding it names the fault
    if any(kind == "APP1" and content.startswith(FLIR) for kind, content in segments):
        return "FLIR"
    is_raw = any(kind == "APP3" for kind, _ in segments)
    is_tagged = any(kind == "APP4" and content.startswith(DJI) for kind, content in segments)
    return "DJI" if is_tagged or (is_raw and make.startswith("DJI")) else None


def read_flir(path: Path) -> tuple[NDArray[np.float32], Image.Image | None]:
    """Read degrees Celsius (H, W) and the photo of a radiometric JPEG of FLIR, None without one.

    The measurement is that of the camera's settings (emissivity, distance, air). The photo has
    another size and another view. The package flyr is required. InputError: damaged, or turned.
    """
    # Not flyr.unpack, which opens embedded images of any format: Pillow's EPS starts a program.
    from flyr.records import RecordIndex, extract_flir_app1, parse_flir_records
    from flyr.thermal import parse_camera_info, parse_raw_data
    from flyr.thermogram import FlyrThermogram

    data = read_bytes(path)
    try:
        with Image.open(io.BytesIO(data), formats=("JPEG",)) as image:
            turn = image.getexif().get(Base.Orientation, 1)
        stream = extract_flir_app1(io.BytesIO(data))
        records = parse_flir_records(stream)
        raw = parse_raw_data(stream, records[RecordIndex.RAW_DATA.value])[2]
        camera = parse_camera_info(stream, records[RecordIndex.CAMERA_INFO.value])
        with np.errstate(all="ignore"):  # what is not finite is refused by the reader
            celsius = FlyrThermogram(raw, camera).celsius.astype(np.float32)
        photo: Image.Image | None = None
        if entry := records.get(RecordIndex.EMBEDDED_IMAGE.value):
            stream.seek(entry[2] + 32)  # after the header of the record
            content = io.BytesIO(stream.read(entry[3]))
            photo = Image.open(content, formats=("JPEG", "PNG")).convert("RGB")
    except (*UNREADABLE, ArithmeticError, MemoryError) as error:
        raise InputError(
            f"{path}: its measurement cannot be read ({one_line(error)}); {LEFT_OUT}."
        ) from error
    if turn != 1:
        raise InputError(f"{path} has the EXIF orientation {turn}, its measurement has none.")
    return celsius, photo


def unpack_flir(folder: Path, out: Path) -> tuple[int, int]:
    """Write thermal/NAME.tif (degrees Celsius, float) and rgb/NAME.png of radiometric JPEGs.

    Photo and measurement do not show the same pixels: align them before training.

    Args:
        folder: has radiometric JPEGs of FLIR; other files are left out.
        out: new folder.

    Returns:
        numbers of thermal images and of photos.
    """
    found = [path for path in sorted(folder.iterdir()) if maker_of(path) == "FLIR"]
    if not found or out.exists():
        raise InputError(f"expected FLIR's files in {folder}, and no {out} yet.")
    photos = 0
    for path in found:
        celsius, photo = read_flir(path)
        images = {out / f"thermal/{path.stem}.tif": Image.fromarray(celsius)}
        if photo is not None:
            images[out / f"rgb/{path.stem}.png"] = photo
            photos += 1
        for target, image in images.items():
            target.parent.mkdir(parents=True, exist_ok=True)
            content = io.BytesIO()
            image.save(content, "TIFF" if target.suffix == ".tif" else "PNG")
            write_atomic(target, content.getvalue())
    return len(found), photos


def kind_of(values: NDArray[Any]) -> str:
    """Return the type of stored values: float, or that of whole numbers, such as uint16."""
    return "float" if values.dtype.kind == "f" else str(values.dtype)


def points_of(values: NDArray[Any]) -> NDArray[np.float64]:
    """Return `POINTS` of the values of an image, sorted, the smallest and the largest included."""
    order = np.linspace(0, values.size - 1, POINTS).round().astype(np.int64)
    return np.sort(values, axis=None)[order].astype(np.float64)


def found_range(points: NDArray[np.float64], unit: Unit | None) -> Range:
    """Return the limits of `auto` of points (N, POINTS) of stored values, rounded.

    In degrees Celsius to 0.01, or without unit in stored values. InputError: one value everywhere.
    """
    low, high = np.quantile(points, (TAIL, 1 - TAIL)).tolist()
    if unit is None:
        low, high = (float(f"{value:.6g}") for value in (low, high))
    else:
        low, high = (round(unit.degrees(value), 2) for value in (low, high))
    if not low < high:
        raise InputError(f"dataset.thermal_range: auto found only the value {low:g}.")
    return low, high


def mixed(
    images: Mapping[str, tuple[str, NDArray[np.float64]]], unit: Unit | None
) -> list[tuple[str, str]]:
    """Find images whose values have another type, or look like another unit, than most.

    Units are those of real numbers without a setting; with one, each file was compared with it.

    Args:
        images: name -> type of the stored values (`kind_of`), and `points_of` them.
        unit: of the setting.

    Returns:
        names, each with a sentence.
    """
    looks = {name: kind for name, (kind, _) in images.items()}
    if len(set(looks.values())) > 1:
        text = "thermal is {}, of most images {}; store values of one type."
    elif unit is None and "float" in looks.values():
        looks = {name: likely_unit(points) for name, (_, points) in images.items()}
        text = "thermal values look like {}, of most images {}; store values in one unit."
    known = Counter(filter(None, looks.values())).most_common()
    if len(known) < 2:
        return []
    usual = known[0][0]
    return [(n, text.format(look, usual)) for n, look in looks.items() if look not in ("", usual)]


def check_unit(values: NDArray[Any], unit: Unit | None, path: Path) -> None:
    """Refuse grey levels of 8 bits, and values that look like another unit than a named one."""
    if unit is None or not unit.name:
        return
    found = "grey levels of 8 bits"
    if values.dtype != np.uint8:  # some pixels are enough for a median
        found = likely_unit(values[::4, ::4], unit)
    if found not in ("", unit.name):
        raise InputError(
            f"{path}: expected {unit.name}, but its values look like {found}; store one unit, or "
            "set that of dataset.thermal_range."
        )


def likely_unit(values: NDArray[Any], unit: Unit | None = None) -> str:
    """Return the first unit in which the median is plausible, `unit` before others; "": none.

    "" also for an image of one value, which shows nothing.
    """
    median = np.median(values)
    for known in (*([] if unit is None else [unit]), *UNITS.values()):
        if PLAUSIBLE[0] < known.degrees(median) < PLAUSIBLE[1]:
            return known.name if values.min() < values.max() else ""
    return ""
