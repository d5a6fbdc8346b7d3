"""Read intrinsics: the value of --camera, COLMAP's camera lines, JSON, YAML and XML of many tools.

Start at `parse_camera`; the formats of files are the registry CAMERAS.
"""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from reobj.cameras import Camera, camera_parameters, usable
from reobj.files import load_json, load_npz, read_text, shortened
from reobj.formats import AUTO, Format, Probe, Registry
from reobj.types import COORDINATE_MAX, ReobjError

Size = tuple[int, int] | None
CAMERA_FORMS = (  # the numbers in OpenCV's order
    "fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]; MODEL WIDTH HEIGHT PARAMS of COLMAP; or a file"
)


def parse_camera(text: str, size: tuple[int, int], fmt: str = AUTO) -> Camera | None:
    """Parse the value of --camera: numbers, a camera line of COLMAP, or a file.

    Args:
        text: `fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]`, pixels; `[ID] MODEL WIDTH HEIGHT PARAMS`;
            or a file in a format of CAMERAS. fmt: the format, of a file.
        size: (w, h) of the frames, and of a camera without a size.
    Returns:
        the camera, resized to the frames if the aspect ratio is the same; None of an empty text.
    Raises:
        ReobjError: anything else, or a camera that does not fit the frames.

    >>> parse_camera("500,500,320,240", (640, 480)).model
    'PINHOLE'
    """
    camera = stated_camera(text, size, fmt)
    return None if camera is None else fitted_camera(camera, size, f"--camera {text:.200}")


CAMERA_MAX = 1 << 20  # characters of a file, a thousand times what a camera takes


def stated_camera(text: str, size: Size, fmt: str = AUTO) -> Camera | None:
    """Parse as `parse_camera` does, but return the camera at its own size, unchecked.

    Args:
        size: of a camera without a size; None: refuse it.
    """
    if not text.strip():
        return None
    try:
        if os.path.isfile(text):  # does not raise for long texts
            return read_camera(Path(text), size, fmt)
        return _camera_of_rows(_rows(text), size)
    except ReobjError as error:
        raise ReobjError(f"--camera {text:.200}: {str(error).removeprefix(f'{text}: ')}") from None
    except (ValueError, IndexError):
        fault = f"neither a file nor a camera; expected {CAMERA_FORMS}"
        raise ReobjError(f"--camera {text:.200}: {fault}") from None


def read_camera(path: Path, size: Size, fmt: str = AUTO) -> Camera:
    """Read a camera file in a format of CAMERAS; size: of a camera without a size."""
    if path.stat().st_size > CAMERA_MAX:
        raise ReobjError(f"{path}: more than {CAMERA_MAX} bytes, not a camera file")
    try:
        return CAMERAS.find(path, fmt).read(path, size)
    except ReobjError as error:
        raise ReobjError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception:  # files of other programs hold any type
        raise ReobjError(f"{path}: not a camera file; expected {CAMERA_FORMS}") from None


def fitted_camera(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """Return the camera resized to (w, h) `size`.

    Raises:
        ReobjError: another aspect ratio; a principal point more than .2 sides off the middle, or a
            focal length outside .1 to 10 longer sides, as no lens has; a distortion that few pixels
            are invertible for.
    """
    refuse_unusable(camera, where)
    width = camera.width
    height = camera.height
    if abs(width * size[1] - height * size[0]) > max(width, height, *size):  # more than rounding
        raise ReobjError(
            f"{where}: a camera of {width}x{height} images, but the frames are {size[0]}x{size[1]};"
            " expected the same aspect ratio (rotated or cropped video?)"
        )
    camera = camera.resized(size)
    K = camera.K
    off_centre = np.abs(K[:2, 2] / size - 0.5).max() > 0.2
    if off_centre or not 0.1 < K[0, 0] / max(size) < 10:
        raise ReobjError(
            f"{where}: focal length {K[0, 0]:.0f} px and centre ({K[0, 2]:.0f}, {K[1, 2]:.0f}) "
            f"do not fit frames of {size[0]}x{size[1]} as they are read (rotated? resized?)"
        )
    is_brown = camera.model in ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
    ratio = pinhole_ratio(camera)
    if ratio < (0.4 if is_brown else 0.1):  # usual ones have .7 and more, fisheyes of 180 deg .4
        raise ReobjError(
            f"{where}: {camera_line(camera)}: its distortion is invertible for only "
            f"{100 * ratio:.0f} % of the pixels; check the order of the distortion terms"
        )
    return camera


def refuse_unusable(camera: Camera, where: str) -> None:
    """Refuse a camera without a size, finite parameters and positive focal lengths."""
    try:
        fault = (
            "" if usable(camera) else "expected a size, finite numbers and focal lengths above 0"
        )
    except ReobjError as error:  # a panorama has no K
        fault = str(error)
    if fault:
        raise ReobjError(f"{where}: {camera_line(camera)}: {fault}")


def pinhole_ratio(camera: Camera) -> float:
    """Return the fraction of a camera's pixels, on a grid, whose distortion is plausible.

    It must be invertible within its fold, and change the radius from the image centre by a factor
    of at most 3, beyond what a pinhole image can show.
    """
    sides = ((np.arange(16) + 0.5) / 16 * side for side in (camera.width, camera.height))
    pixel = np.stack(np.meshgrid(*sides), -1)  # (16, 16, 2)
    offsets = np.stack([camera.undistort(pixel), pixel]) - camera.K[:2, 2]
    ideal, radius = np.linalg.norm(offsets, axis=-1)
    return float(((ideal < 3 * radius) & (radius < 3 * ideal)).mean())


def camera_line(camera: Camera) -> str:
    """Format a camera as COLMAP does: MODEL WIDTH HEIGHT PARAMS, with all digits."""
    return " ".join(map(str, (camera.model, camera.width, camera.height, *camera.params)))


def _rows(text: str) -> list[list[str]]:
    """Split a text into lines of words; `#` begins a comment."""
    lines = [line.partition("#")[0].replace(",", " ").split() for line in text.splitlines()]
    return [words for words in lines if words]


def _is_model_line(rows: list[list[str]]) -> bool:
    """Test for a line of COLMAP's cameras.txt: [ID] MODEL WIDTH ..."""
    return any(re.fullmatch("[A-Z][A-Z0-9_]{3,}", word) for row in rows[:1] for word in row[:2])


def _camera_of_rows(rows: list[list[str]], size: Size) -> Camera:
    """Read numbers, a matrix K, or a line of COLMAP's cameras.txt."""
    if _is_model_line(rows):
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


def colmap_camera(words: Sequence[str]) -> Camera:
    """Make a camera from the words MODEL WIDTH HEIGHT PARAMS of a line of COLMAP's cameras.txt.

    Raises:
        ReobjError: not a model of the installed pycolmap, or not its parameters.
        ValueError: a word is not a number.
    """
    model, width, height, *params = words
    camera = Camera(model, int(width), int(height), tuple(map(float, params)))
    sides = (camera.width, camera.height)
    if not np.isfinite(camera.params).all() or not 1 <= min(sides) <= max(sides) <= COORDINATE_MAX:
        text = f"a number is not finite, or the size not of 1 to {COORDINATE_MAX:g} pixels"
        raise ReobjError(f"{' '.join(words)!r}: {text}")
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
    terms = [*distortion, *[0.0] * 8][:8]
    count = 8 if any(terms[4:]) else 4 * any(terms)
    model = {0: "PINHOLE", 4: "OPENCV", 8: "FULL_OPENCV"}[count]
    params = (fx, fy, cx, cy, *terms[:count])
    if not np.isfinite(params).all() or min(fx, fy) <= 0:
        raise ReobjError("a number is not finite, or a focal length not positive")
    return Camera(model, *_sized(size), params)


def _focal_and_centre(matrix: Any) -> tuple[float, ...]:
    """Return fx, fy, cx, cy of four numbers, or of K (3x3 or 4x4, either order)."""
    flat = np.array(matrix, np.float64).ravel()
    if flat.size == 4:  # Kalibr, EuRoC
        return tuple(flat.tolist())
    if flat.size not in (9, 16):
        raise ReobjError(f"intrinsics of {flat.size} numbers; expected fx, fy, cx, cy or 3x3, 4x4")
    side = math.isqrt(flat.size)
    K = flat.reshape(side, side)[:3, :3]
    K = K.T if K[2, :2].any() else K  # Open3D, Record3D
    if abs(K[0, 1]) > 0.001 * abs(K[0, 0]):  # half a pixel at the border of usual images
        raise ReobjError(f"a skew of {K[0, 1]:g} in the matrix, which no camera model here has")
    return tuple(K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())


def image_side(value: Any) -> int:
    """Convert the width or height of images, px."""
    side = float(value)
    if not 1 <= side <= COORDINATE_MAX:
        raise ReobjError(f"images of {side:g} pixels; expected a width and height")
    return int(side)


def _sized(size: Size) -> tuple[int, int]:
    if size is None:
        raise ReobjError("no image size; expected MODEL WIDTH HEIGHT PARAMS, or JSON with w and h")
    return size


# ---- Keys of JSON, YAML, XML and npz -------------------------------------------------------------

FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "EQUIDISTANT", "KANNALA_BRANDT4", "KANNALABRANDT8")
BROWN = (
    "", "NONE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV",
    "PERSPECTIVE", "PLUMB_BOB", "RATIONAL_POLYNOMIAL", "RADTAN", "RADIAL_TANGENTIAL",
    "BROWN_CONRADY", "RECTIFIED",
)  # fmt: skip
# Names of the keys that are read, and their other spellings as `_plain` returns them
NAMES = {
    "fx": "flx|f|focal", "fy": "fly", "cx": "ppx", "cy": "ppy",
    "K": "k|cameramatrix|intrinsicmatrix|mtx|intrinsics?",  # k, d: of ROS 2
    "D": "d|dist(ortion)?(coef|coeffs?|coefs|coefficients?)?|coeffs?|kc",  # kc: Bouguet's toolbox
    "width": "[wW]|im(a)?ge?width", "height": "[hH]|im(a)?ge?height",
    "sides": "resolution|camerares|im(a)?ge?size|imageresolution",
    "model": "cameramodel|modeltype", "lens": "distortionmodel",  # of ROS and Kalibr
    "fisheye": "isfisheye|fisheyemodel", "angle": "cameraanglex",
}  # fmt: skip
# Keys that change the camera; not the matrices of rectified images in ROS's files
CAMERA_LIKE = (
    r".*((?<!un)distort|focal|intrinsic|cam(era)?ma?t(ri)?x|principal|mirrorparam).*|[kps]\d|"
    r"[fc][xyuv]|[muv][0uv]|xi|skew|fov[xy]?|mtx|im(a)?ge?(shape|dim).*|k|f|d|camera2.*|"
    rf"(radial|tangential).*|{NAMES['D']}|{NAMES['sides']}"
)


def _plain(key: str) -> str:
    """Return a key without a prefix of ORB-SLAM; if long, in small letters and digits alone."""
    key = re.sub(r"^Camera1?\.", "", key.replace("Camera.type", "model"))
    plain = re.sub(r"[^a-z0-9]", "", key.lower())
    return plain if len(plain) > 2 else key


def _flat(data: dict[str, Any]) -> dict[str, tuple[str, Any]]:
    """Return keys as they are written, and values, by the names of NAMES or `_plain`.

    Also those of nested cameras.
    """
    found: dict[str, tuple[str, Any]] = {}
    for key, value in data.items():
        plain = _plain(str(key))
        is_group = isinstance(value, dict) and "data" not in value
        if is_group and re.fullmatch(f"cam(era)?|.*parameters|{CAMERA_LIKE}", plain):
            found |= _flat(value)
        else:
            names = [name for name, form in NAMES.items() if re.fullmatch(form, plain)]
            found[(names or [plain])[0]] = (str(key), value)
    return found


def _numbers(value: Any) -> list[float]:
    """Return the numbers in a value, nested or under `data`; [] of anything else."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        return [] if value is None else np.array(value, np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return []


def _terms(keys: dict[str, Any], *names: str) -> list[float]:
    """Take the distortion in the order of its names: by name, or from a list; else 0."""
    values = _numbers(keys.pop("D", None))
    if any(values[len(names) :]):
        raise ReobjError(f"{len(values)} distortion coefficients; expected {','.join(names)}")
    listed = [*values, *[0.0] * len(names)]
    return [float(keys.pop(name, value)) for name, value in zip(names, listed, strict=False)]


def _pinhole(keys: dict[str, Any], size: Size) -> tuple[float, ...] | None:
    """Take fx, fy, cx, cy, or a matrix; None without a focal length."""
    if "K" in keys:
        return _focal_and_centre(_numbers(keys.pop("K")))
    angle = keys.pop("angle", None)
    if "fx" not in keys and angle is not None and size:
        if not 0 < float(angle) < math.pi:
            raise ReobjError(f"camera_angle_x {angle}, expected radians between 0 and pi")
        keys["fx"] = 0.5 * size[0] / math.tan(0.5 * float(angle))
    if "fx" not in keys:
        return None
    fx = keys.pop("fx")
    middle = [] if {"cx", "cy"} & keys.keys() else [0.5 * side for side in _sized(size)]
    centre = middle or [keys.pop(name, None) for name in ("cx", "cy")]
    return tuple(map(float, (fx, keys.pop("fy", fx), *centre)))


def _lens(keys: dict[str, Any]) -> str:
    """Take the name of the lens model, in capitals; "" without one.

    Raises:
        ReobjError: neither a model of pycolmap, nor one of FISHEYE and BROWN.
    """
    model, lens = (str(keys.pop(name, None) or "").upper() for name in ("model", "lens"))
    model = lens if model in ("", "PINHOLE") and lens else model
    model = re.sub("[ -]", "_", model.removeprefix("DISTORTION."))  # of RealSense
    if not any(_numbers(keys.get("D"))):
        model = re.sub("(INVERSE|MODIFIED)_BROWN", "BROWN", model)
    if model not in (*FISHEYE, *BROWN):
        camera_parameters(model)  # refuses unknown ones
    return model


def camera_of_keys(data: dict[str, Any], size: Size) -> Camera | None:
    """Make a camera from the keys of JSON, YAML, XML or npz of various tools.

    Args:
        data: focal length `fx`, `fy` (`fl_x`, or `camera_angle_x` in radians) and centre `cx`,
            `cy`, or a matrix (`K`, `camera_matrix`, `mtx`, ...); distortion by name (`k1`, ...) or
            as a list in OpenCV's order (DISTORTION); `w`, `h` or `width`, `height`; `model`
            or `camera_model`, with COLMAP's `params` or the names of its parameters. All of these
            may be in an object `camera`, `intrinsics`, ...
        size: (w, h) where the data have none.
    Returns:
        the camera at the size of the data; None without a focal length.
    Raises:
        ReobjError: several cameras, an unknown lens model, or a key that looks like a camera's and
            is not read.
    """
    rigs = [name for name, v in data.items() if isinstance(v, dict) and "intrinsics" in v]
    if len(rigs) > 1:  # Kalibr
        raise ReobjError(f"cameras {', '.join(rigs)}; expected one: leave the others out")
    found = _flat(data[rigs[0]] if rigs else data)
    keys = {name: value for name, (_, value) in found.items()}
    sides = _numbers(keys.pop("sides", None)) or [keys.pop(k, None) for k in ("width", "height")]
    size = size if None in sides else (image_side(sides[0]), image_side(sides[1]))
    model = _lens(keys)
    params = keys.pop("params", None)
    pinhole = None if model and params is not None else _pinhole(keys, size)
    if model and params is not None:
        camera = colmap_camera([model, *map(str, (*_sized(size), *params))])
    elif pinhole is None:
        return None
    elif str(keys.pop("fisheye", "")).lower() in ("true", "1") or model in FISHEYE:
        terms = _terms(keys, "k1", "k2", "k3", "k4")
        camera = Camera("OPENCV_FISHEYE", *_sized(size), (*pinhole, *terms))
    elif model in BROWN:
        if not {"k5", "k6"} & keys.keys() and any(_numbers(keys.get("k4"))):
            raise ReobjError("k4 without k5 and k6: of a fisheye lens (camera_model OPENCV_FISHEYE)"
                             ", or of OpenCV's rational model (k5 and k6 too, if 0)")  # fmt: skip
        camera = brown_camera(size, *pinhole, *_terms(keys, *"k1 k2 p1 p2 k3 k4 k5 k6".split()))
    else:
        raise ReobjError(f"a {model} camera without `params`, the numbers of COLMAP's model")
    for name, value in keys.items():  # that is left, and has a number that is not the camera's
        key = found[name][0] if name in found else name
        repeated = () if key[1:].isdecimal() else camera.params  # not those of k1, p1
        lost = {*_numbers(value)} - {0.0, *repeated}
        if lost and re.fullmatch(CAMERA_LIKE, name, re.IGNORECASE):
            raise ReobjError(
                f"{key!r} is not read; expected fx, fy, cx, cy or a matrix K, k1, k2, p1, p2, k3 "
                "or a list dist_coeffs in OpenCV's order, width, height"
            )
    return camera


def read_yaml(path: Path) -> dict[str, Any]:
    """Read YAML, also OpenCV's with `%YAML:1.0` and `!!opencv-matrix`; all scalars are text.

    1e-3 is none of YAML 1.1's numbers.
    """
    text = re.sub(r"\A\s*%YAML.*", "", read_text(path, CAMERA_MAX))
    try:
        found = list(filter(None, yaml.load_all(text, yaml.BaseLoader)))  # ROS 2 ends with ---
    except yaml.YAMLError as error:
        raise ReobjError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if len(found) != 1 or not isinstance(found[0], dict):
        raise ReobjError(f"{path}: expected one document of `key: value`")
    return dict(found[0])


def _of_xml(element: ElementTree.Element) -> Any:
    """Return a dict of the children of an element of OpenCV's FileStorage, or its words."""
    words = (element.text or "").split()
    return {e.tag: _of_xml(e) for e in element} or (words if len(words) != 1 else words[0])


# ---- Formats of files ----------------------------------------------------------------------------

ReadCamera = Callable[[Path, Size], Camera]


def _rows_of(form: str) -> Callable[[Probe], bool]:
    """Test for a text file, no YAML, JSON or XML, that holds rows of a form."""

    def test(probe: Probe) -> bool:
        marked = probe.suffix in (".pincam", ".yaml", ".yml") or probe.kind != "text"
        rows = [] if marked or probe.lines[0][0] == "%" else _rows("\n".join(probe.lines))
        is_square = len(rows) in (3, 4) and {*map(len, rows)} == {len(rows)}
        forms = {
            "kitti": any(map(KITTI_LINE.fullmatch, probe.lines)),
            "colmap": _is_model_line(rows), "matrix": is_square, "numbers": len(rows) == 1,
        }  # fmt: skip
        return next((name for name, fits in forms.items() if fits), "") == form

    return test


KITTI_LINE = re.compile(r"P(_rect_0)?\d:(\s+\S+){12}")


def _read_kitti(path: Path, size: Size) -> Camera:
    """Read the matrix of rectified images, the same for all cameras."""
    lines = filter(KITTI_LINE.fullmatch, map(str.strip, read_text(path, CAMERA_MAX).splitlines()))
    rows = np.array([line.split()[1:] for line in lines], np.float64).reshape(-1, 3, 4)
    if np.ptp(rows[:, :, :3], axis=0).any():
        raise ReobjError("cameras with different matrices; expected one: leave the others out")
    return brown_camera(size, *_focal_and_centre(rows[0, :, :3]))


def _read_rows(path: Path, size: Size) -> Camera:
    return _camera_of_rows(_rows(read_text(path, CAMERA_MAX)), size)


def _read_pincam(path: Path, size: Size) -> Camera:
    width, height, *params = map(float, read_text(path, CAMERA_MAX).split())
    return brown_camera((image_side(width), image_side(height)), *params)


def _keys_of(read: Callable[[Path], dict[str, Any]]) -> ReadCamera:
    def read_camera(path: Path, size: Size) -> Camera:
        data = read(path)
        if camera := camera_of_keys(data, size):
            return camera
        raise ReobjError(f"no known focal length among {shortened(sorted(map(str, data)))}; "
                         f"expected {CAMERA_FORMS}")  # fmt: skip

    return read_camera


def _arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of an npz file, or the matrix K of an npy file."""
    is_npz = path.suffix.lower() == ".npz"
    return load_npz(path)[0] if is_npz else {"K": np.load(path, allow_pickle=False)}


FRAME_PX, OWN_PX, UNREAD = "px of the frames", "px of the size in it", "rectified images"
CAMERAS: Registry[ReadCamera] = Registry("cameras", "--camera-format", [
    Format("colmap", "COLMAP: `cameras.txt` with one camera, `[ID] MODEL WIDTH HEIGHT PARAMS`, of "
           "any model with a focal length", _rows_of("colmap"), _read_rows, units=OWN_PX),
    Format("numbers", "one line `fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]`, OpenCV's order",
           _rows_of("numbers"), _read_rows, units=FRAME_PX),
    Format("kitti", "KITTI: `calib.txt` and `calib_cam_to_cam.txt`, `P0:` or `P_rect_00:`",
           _rows_of("kitti"), _read_kitti, units=FRAME_PX, unread="images before rectification"),
    Format("matrix", "K.txt, ScanNet: matrix K, 3x3 or 4x4", _rows_of("matrix"), _read_rows,
           units=FRAME_PX),
    Format("pincam", "ARKitScenes: `w h fx fy cx cy`", lambda p: p.suffix == ".pincam",
           _read_pincam, units=OWN_PX),
    Format("json", "COLMAP, nerfstudio, instant-ngp, OpenCV, Open3D, Record3D, RealSense",
           lambda p: p.suffix not in (".yaml", ".yml") and isinstance(p.json, dict),
           _keys_of(load_json), units=OWN_PX),
    Format("yaml", "OpenCV, ROS, Kalibr (one camera), EuRoC, ORB-SLAM, VINS, PyYAML",
           lambda p: p.suffix in (".yaml", ".yml") or "".join(p.lines[:1]).startswith("%YAML"),
           _keys_of(read_yaml), units=OWN_PX, unread=UNREAD),
    Format("xml", "OpenCV: FileStorage", lambda p: getattr(p.root, "tag", "") == "opencv_storage",
           _keys_of(lambda path: _of_xml(ElementTree.fromstring(read_text(path)))), units=OWN_PX),
    Format("npz", "OpenCV: arrays `mtx`, `dist`, or as in JSON; `.npy`: matrix K",
           lambda p: p.suffix in (".npz", ".npy"), _keys_of(_arrays), units=OWN_PX),
])  # fmt: skip
