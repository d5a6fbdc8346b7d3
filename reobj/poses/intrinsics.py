"""Read intrinsics: the value of --camera, COLMAP's camera lines, JSON and YAML of many tools.

Start at `parse_camera`.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reobj.cameras import Camera, camera_parameters, checked_camera
from reobj.files import load_json, read_text
from reobj.types import COORDINATE_MAX, ReobjError

CAMERA_FORMS = (  # the numbers in OpenCV's order
    "fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]; MODEL WIDTH HEIGHT PARAMS of COLMAP; or a file"
)


def parse_camera(text: str, size: tuple[int, int]) -> Camera | None:
    """Parse the value of --camera: numbers, a camera line of COLMAP, or a file.

    Args:
        text: `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]`, pixels; `[ID] MODEL WIDTH HEIGHT PARAMS`;
            or a file with one of these (a cameras.txt of one camera), a 3x3 or 4x4 matrix K, JSON
            (`camera_from_json`), YAML (`camera_from_yaml`), or ARKitScenes' .pincam.
        size: (w, h) of the frames, and of a camera without a size.
    Returns:
        the camera, resized to the frames if the aspect ratio is the same; None of an empty text.
    Raises:
        ReobjError: anything else, or a camera that does not fit the frames.

    >>> parse_camera("500,500,320,240", (640, 480)).model
    'PINHOLE'
    """
    camera = stated_camera(text, size)
    return None if camera is None else fitted_camera(camera, size, f"--camera {text:.200}")


CAMERA_MAX = 1 << 20  # characters of a file; chosen: a thousand times what a camera takes


def stated_camera(text: str, size: tuple[int, int] | None) -> Camera | None:
    """Parse as `parse_camera` does, but return the camera at its own size, unchecked.

    Args:
        size: of a camera without a size; None: refuse it.
    """
    if not text.strip():
        return None
    is_file = os.path.isfile(text)  # does not raise for long texts
    try:
        content = read_text(Path(text), CAMERA_MAX) if is_file else text
        if is_file and content.lstrip()[:1] in ("{", "["):
            camera = camera_from_json(load_json(Path(text)), size)
        elif is_file and (content.startswith("%YAML") or text.endswith((".yaml", ".yml"))):
            camera = camera_from_yaml(read_yaml(Path(text)), size)
        elif is_file and text.endswith(".pincam"):  # w h fx fy cx cy
            width, height, *params = map(float, content.split())
            camera = brown_camera((image_side(width), image_side(height)), *params)
        else:
            camera = _camera_from_text(content, size)
        if camera is None:
            raise ReobjError(f"no focal length; expected {CAMERA_FORMS}")
    except ReobjError as error:
        raise ReobjError(f"--camera {text:.200}: {error}") from None
    except (ValueError, TypeError, KeyError, IndexError, AttributeError):
        fault = "not a camera file" if is_file else "neither a file nor a camera"
        raise ReobjError(f"--camera {text:.200}: {fault}; expected {CAMERA_FORMS}") from None
    return camera


def fitted_camera(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """Return the camera resized to (w, h) `size`; refuse one of another aspect ratio."""
    width = camera.width
    height = camera.height
    try:
        camera_parameters(camera.model)  # refuses panoramas, which have no K
    except ReobjError as error:
        raise ReobjError(f"{where}: {error}") from None
    if abs(width * size[1] - height * size[0]) > max(width, height, *size):  # more than rounding
        raise ReobjError(
            f"{where}: a camera of {width}x{height} images, but the frames are {size[0]}x{size[1]};"
            " expected the same aspect ratio (rotated or cropped video?)"
        )
    camera = checked_camera(camera.resized(size), where)
    is_brown = camera.model in ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
    least = 0.4 if is_brown else 0.1  # usual ones have .7 and more, fisheyes of 180 deg .4
    if (ratio := pinhole_ratio(camera)) < least:
        raise ReobjError(
            f"{where}: {camera_line(camera)}: its distortion is invertible for only "
            f"{100 * ratio:.0f} % of the pixels; check the order of the distortion terms"
        )
    return camera


def pinhole_ratio(camera: Camera, count: int = 16) -> float:
    """Return the fraction of a camera's pixels whose distortion is plausible.

    It must be invertible within its fold, and change the radius from the image centre by a factor
    of at most 3, beyond what a pinhole image can show.

    Args:
        count: of the pixels tried along each side.
    """
    x, y = ((np.arange(count) + 0.5) / count * side for side in (camera.width, camera.height))
    pixel = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    centre = camera.K[:2, 2]
    ideal = camera.undistort(pixel) - centre
    radius = np.linalg.norm(pixel - centre, axis=1)
    ideal_radius = np.linalg.norm(ideal, axis=1)
    good = np.isfinite(ideal_radius)
    good &= (ideal_radius < 3 * radius) & (radius < 3 * ideal_radius)
    return float(good.mean())


def camera_line(camera: Camera) -> str:
    """Format a camera as COLMAP does: MODEL WIDTH HEIGHT PARAMS, with all digits."""
    return " ".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))


def _camera_from_text(text: str, size: tuple[int, int] | None) -> Camera:
    """Read numbers, a matrix K, or a line of COLMAP's cameras.txt; `#` begins a comment."""
    lines = [line.partition("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [words for words in lines if words]
    if any(word.isupper() and not _is_number(word) for words in rows for word in words[:2]):
        if len(rows) > 1:
            raise ReobjError(f"{len(rows)} cameras; expected one")
        return colmap_camera(rows[0][rows[0][0].isdigit() :])
    table = np.array([[float(word) for word in words] for words in rows])
    if table.shape in ((3, 3), (4, 4)):
        return brown_camera(size, *_focal_and_centre(table))
    numbers = table.ravel().tolist()
    if len(rows) != 1 or len(numbers) not in (*range(4, 10), 12):
        raise ReobjError(f"{len(numbers)} numbers; expected {CAMERA_FORMS}")
    return brown_camera(size, *numbers)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def colmap_camera(words: Sequence[str]) -> Camera:
    """Make a camera from the words MODEL WIDTH HEIGHT PARAMS of a line of COLMAP's cameras.txt.

    Raises:
        ReobjError: not a model of the installed pycolmap, or not its parameters.
        ValueError: a word is not a number.
    """
    model, width, height, *params = words
    camera = Camera(model, int(width), int(height), tuple(map(float, params)))
    if not np.isfinite(camera.params).all() or min(camera.width, camera.height) < 1:
        raise ReobjError(f"{' '.join(words)!r}: a number is not finite, or the size not positive")
    camera.to_pycolmap()  # refuses unknown models
    return camera


def brown_camera(
    size: tuple[int, int] | None, fx: float, fy: float, cx: float, cy: float, *distortion: float
) -> Camera:
    """Make a camera from OpenCV's numbers, in the simplest sufficient model of COLMAP.

    Args:
        size: (w, h) px. distortion: k1, k2, p1, p2, k3, k4, k5, k6 (Brown's model, with k4 to k6
            OpenCV's rational one); trailing zeros may be left out.
    """
    terms = [*distortion, *[0.0] * (8 - len(distortion))]
    model = "PINHOLE"
    count = 0
    if any(terms):
        model = "OPENCV"
        count = 4
    if any(terms[4:]):
        model = "FULL_OPENCV"
        count = 8
    params = (fx, fy, cx, cy, *terms[:count])
    if not np.isfinite(params).all() or min(fx, fy) <= 0:
        raise ReobjError("a number is not finite, or a focal length not positive")
    width, height = _sized(size)
    return Camera(model, width, height, params)


def _focal_and_centre(matrix: Any) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of K: 3x3 or 4x4, nested or flat, row by row or column by column."""
    flat = np.array(matrix, np.float64).ravel()
    K = flat.reshape(4, 4)[:3, :3] if flat.size == 16 else flat.reshape(3, 3)
    K = K.T if K[2, :2].any() else K  # Open3D, Record3D
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def camera_from_json(data: Any, size: tuple[int, int] | None) -> Camera | None:
    """Make a camera from the keys of JSON files of various tools.

    Args:
        data: focal length `fx`, `fy` (`fl_x`, or `camera_angle_x` in radians) and centre `cx`,
            `cy`, or a matrix `K`, `camera_matrix`, `intrinsic_matrix`; distortion by name (`k1`,
            ...) or as a list in OpenCV's order (`_is_list`); `w`, `h` or `width`, `height`; `model`
            or `camera_model`, with COLMAP's `params` or the names of its parameters. All of these
            may be in an object `camera` or `intrinsics`.
        size: (w, h) where the data have none.
    Returns:
        the camera at the size of the data; None without a focal length.
    Raises:
        ReobjError: distortion that is not read, an unknown lens model.
    """
    # names and keys, also below, of COLMAP, nerfstudio and instant-ngp, OpenCV and ROS, Open3D,
    # Record3D, RealSense
    fisheye = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT", "KANNALA_BRANDT4")
    brown = (
        "", "NONE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV",
        "PERSPECTIVE", "PLUMB_BOB", "RATIONAL_POLYNOMIAL", "RADTAN", "RADIAL-TANGENTIAL",
        "RADIAL_TANGENTIAL",
    )  # fmt: skip
    data = data | next((data[k] for k in ("camera", "intrinsics") if _is_object(data.get(k))), {})
    for key, value in tuple(data.items()):
        if key.replace("_", "").lower() == "cameramatrix":  # Camera_Matrix, cameraMatrix
            data["camera_matrix"] = value
        elif _is_distortion(key) and _is_object(value) and "data" not in value:
            data |= value  # {"k1": ...}
    sides = (("w", "h"), ("width", "height"), ("image_width", "image_height"))
    size = next(
        ((image_side(data[w]), image_side(data[h])) for w, h in sides if w in data and h in data),
        size,
    )
    model = str(data.get("model", data.get("camera_model", ""))).upper()
    lens = str(data.get("distortion_model", "")).upper()  # of ROS and Kalibr
    model = lens if model in ("", "PINHOLE") and lens else model
    if size and model and "params" in data:
        _check_read(data, camera_parameters(model))
        return colmap_camera([model, *map(str, (*size, *data["params"]))])
    pinhole = _pinhole_of_json(data, size)
    if pinhole is None:
        return None
    if data.get("is_fisheye") or model in fisheye:
        width, height = _sized(size)
        return Camera("OPENCV_FISHEYE", width, height, (*pinhole, *_terms(data, "k1 k2 k3 k4")))
    if model in brown:
        return brown_camera(size, *pinhole, *_terms(data, "k1 k2 p1 p2 k3 k4 k5 k6"))
    return _camera_of_names(model, data, pinhole, _sized(size))


def camera_from_yaml(data: dict[str, Any], size: tuple[int, int] | None) -> Camera | None:
    """Make a camera from YAML of OpenCV, ROS, Kalibr (`cam0`), EuRoC or ORB-SLAM (`Camera.fx`).

    Args:
        data: as `read_yaml` returns it. size: (w, h) where the data have none.
    Returns:
        the camera at the size of the data; None without a focal length.
    Raises:
        ReobjError: several cameras, or an unknown lens model.
    """
    kalibr = [name for name, entry in data.items() if _is_object(entry) and "intrinsics" in entry]
    if len(kalibr) > 1:
        raise ReobjError(f"cameras {', '.join(kalibr)}; expected one: leave the others out")
    data = data[kalibr[0]] if kalibr else data
    keys = {re.sub(r"^Camera1?\.", "", key): data[key] for key in data}
    if len(keys.get("resolution", ())) == 2:
        keys["width"], keys["height"] = keys.pop("resolution")
    if isinstance(keys.get("intrinsics"), list):
        keys |= dict(zip(("fx", "fy", "cx", "cy"), keys.pop("intrinsics"), strict=True))
    return camera_from_json(keys, size)


def image_side(value: Any) -> int:
    """Convert the width or height of images, px."""
    side = float(value)
    if not 1 <= side <= COORDINATE_MAX:
        raise ReobjError(f"images of {side:g} pixels; expected a width and height")
    return int(side)


def _is_object(value: Any) -> bool:
    return isinstance(value, dict)


def _pinhole_of_json(
    data: dict[str, Any], size: tuple[int, int] | None
) -> tuple[float, float, float, float] | None:
    """Return fx, fy, cx, cy from the keys or the matrix of an object; None without focal length."""
    for key in ("camera_matrix", "K", "intrinsic_matrix", "intrinsics", "intrinsic"):
        matrix = data[key].get("data") if _is_object(data.get(key)) else data.get(key)
        if matrix is not None:
            return _focal_and_centre(matrix)
    middle = (0.5 * size[0], 0.5 * size[1]) if size else (math.nan, math.nan)
    centres = (("cx", "cy"), ("ppx", "ppy"))
    cx, cy = next(((data[x], data[y]) for x, y in centres if x in data), middle)
    focals = (("fx", "fy"), ("fl_x", "fl_y"), ("f", "f"), ("focal", "focal"))
    fx, fy = next(((data[x], data.get(y, data[x])) for x, y in focals if x in data), (None, None))
    if fx is None and size and "camera_angle_x" in data:
        angle = float(data["camera_angle_x"])
        if not 0 < angle < math.pi:
            raise ReobjError(f"camera_angle_x {angle:g}, expected radians between 0 and pi")
        fx = fy = 0.5 * size[0] / math.tan(0.5 * angle)
    return None if fx is None or fy is None else (float(fx), float(fy), float(cx), float(cy))


def _terms(data: dict[str, Any], order: str) -> list[float]:
    """Return the distortion in the order of its names, words; 0 where it is not given."""
    names = order.split()
    key = next((key for key, value in data.items() if _is_list(key) and _numbers(value)), "")
    _check_read(data, (*names, key))
    values = _numbers(data.get(key))
    if len(values) > len(names) and any(values[len(names) :]):
        raise ReobjError(f"{len(values)} distortion coefficients; expected {','.join(names)}")
    listed = dict(zip(names, values, strict=False)) or {"k1": data.get("k", 0.0)}
    return [float(data.get(name, listed.get(name, 0.0))) for name in names]


def _is_list(key: str) -> bool:
    """Test for a list of distortion coefficients: dist_coeffs, distCoeff, distortion, D, ..."""
    form = r"dist(ortion)?(coef|coeffs?|coefs|coefficients?)?|coeffs?|kc"  # kc: Bouguet's toolbox
    word = re.sub(r"[_\W]", "", key).lower()
    return key == "D" or re.fullmatch(form, word) is not None


def _is_distortion(key: str) -> bool:
    """Test whether a key looks like distortion; `undistorted` does not."""
    named = re.search(r"(?<!un)distort", key, re.IGNORECASE) is not None
    return named or _is_list(key) or re.fullmatch(r"[kps]\d", key, re.IGNORECASE) is not None


def _numbers(value: Any) -> list[float]:
    """Return the numbers in a value, nested or under `data`; [] of anything else."""
    values = np.ravel(value.get("data", []) if _is_object(value) else value)
    return values.astype(np.float64).tolist() if values.dtype.kind in "iuf" else []


def _check_read(data: dict[str, Any], read: Sequence[str]) -> None:
    """Refuse distortion under keys other than those that are read, unless it is 0 or repeated."""
    known = [_numbers(data.get(key)) for key in read if _is_list(key)]
    for key, value in data.items():
        if key in read or not _is_distortion(key):
            continue
        found = _numbers(value)
        if any(found) and found not in known:
            expected = ", ".join(filter(None, read))
            raise ReobjError(f"the distortion {key!r} is not read; expected {expected}, or a list "
                             "distortion_coefficients in OpenCV's order")  # fmt: skip


def _camera_of_names(
    model: str, data: dict[str, Any], pinhole: Sequence[float], size: tuple[int, int]
) -> Camera:
    """Make a camera of another of COLMAP's models from parameters with its names."""
    values = data | dict(zip(("fx", "fy", "cx", "cy"), pinhole, strict=True)) | {"f": pinhole[0]}
    names = camera_parameters(model)
    _check_read(data, names)
    missing = [name for name in names if name not in values]
    if missing:
        raise ReobjError(f"no {', '.join(missing)} of a {model} camera")
    return Camera(model, *size, tuple(float(values[name]) for name in names))


def _sized(size: tuple[int, int] | None) -> tuple[int, int]:
    if size is None:
        raise ReobjError("no image size; expected MODEL WIDTH HEIGHT PARAMS, or JSON with w and h")
    return size


# ---- YAML ----------------------------------------------------------------------------------------


def read_yaml(path: Path) -> dict[str, Any]:
    """Read the subset of YAML in camera files: nested mappings of words, numbers and lists.

    Enough for OpenCV's FileStorage, ROS's camera_info, Kalibr's camchain, EuRoC's sensor.yaml.
    Indentation nests; `[1, 2]` may span lines; lines `- 1` and `- [1, 2]` are lists. Tags, comments
    and document marks are skipped.

    Raises:
        ReobjError: no form matches a line.
    """
    text = re.sub(r"(^|\s)#.*", r"\1", read_text(path, CAMERA_MAX), flags=re.MULTILINE)
    text = re.sub(r"\[[^\[\]]*\]", lambda m: " ".join(m[0].split()), text)  # lists to one line
    root: dict[str, Any] = {}
    stack: list[tuple[int, Any]] = [(-1, root)]  # indentation and content of open mappings
    key = ""
    key_indent = -1
    for line in text.splitlines():
        if not line.strip() or line.startswith(("%", "---", "...")):
            continue
        indent = len(line) - len(line.lstrip())
        word = line.strip()
        is_item = word.startswith("- ")
        while not is_item and stack[-1][0] >= indent and len(stack) > 1:
            stack.pop()
        parent = stack[-1][1]
        if is_item:
            rows = parent.get(key) if isinstance(parent.get(key), list) else []
            parent[key] = [*rows, _value(word[2:])]
            continue
        if key and indent > key_indent and parent.get(key, "") is None:
            parent[key] = {}
            stack.append((key_indent, parent[key]))
            parent = parent[key]
        name, colon, value = word.partition(":")
        if not colon:
            raise ReobjError(f"{path}: cannot parse {word[:60]!r}; expected `key: value`")
        key = name.strip(" \"'")
        key_indent = indent
        value = re.sub(r"^!\S+", "", value.strip()).strip()
        parent[key] = _value(value) if value else None
    return root


def _value(text: str) -> Any:
    """Convert a word, a number or a list of them."""
    text = text.strip()
    if text.startswith("["):
        return [_value(part) for part in text.strip("[]").split(",") if part.strip()]
    try:
        return float(text)
    except ValueError:
        return text.strip("\"'")
