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

from reobj.cameras import Camera, camera_parameters, checked_camera, usable
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


CAMERA_MAX = 1 << 20  # characters of a file; chosen: a thousand times what a camera takes


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
        camera = CAMERAS.reader(path, fmt)(path, size)
    except ReobjError as error:
        raise ReobjError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    except Exception:  # files of other programs hold any type
        raise ReobjError(f"{path}: not a camera file; expected {CAMERA_FORMS}") from None
    if camera is None:
        raise ReobjError(f"{path}: no focal length; expected {CAMERA_FORMS}")
    return camera


def fitted_camera(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """Return the camera resized to (w, h) `size`; refuse one of another aspect ratio."""
    width = camera.width
    height = camera.height
    try:
        camera_parameters(camera.model)  # refuses panoramas, which have no K
    except ReobjError as error:
        raise ReobjError(f"{where}: {error}") from None
    refuse_unusable(camera, where)
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


def refuse_unusable(camera: Camera, where: str) -> None:
    """Refuse a camera without a size, finite parameters and positive focal lengths."""
    if not usable(camera):
        text = "expected a size, finite numbers and focal lengths above 0"
        raise ReobjError(f"{where}: {camera_line(camera)}: {text}")


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


def _focal_and_centre(matrix: Any) -> tuple[float, ...]:
    """Return fx, fy, cx, cy of four numbers, or of K (3x3 or 4x4, either order)."""
    flat = np.array(matrix, np.float64).ravel()
    if flat.size == 4:  # Kalibr, EuRoC
        return tuple(flat.tolist())
    if flat.size not in (9, 16):
        raise ReobjError(f"intrinsics of {flat.size} numbers; expected fx, fy, cx, cy or 3x3, 4x4")
    K = flat.reshape(4, 4)[:3, :3] if flat.size == 16 else flat.reshape(3, 3)
    K = K.T if K[2, :2].any() else K  # Open3D, Record3D
    if abs(K[0, 1]) > 0.001 * abs(K[0, 0]):  # chosen: less than half a pixel at the border
        raise ReobjError(f"a skew of {K[0, 1]:g} in the matrix, which no camera model here has")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


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
DISTORTION = r"dist(ortion)?(coef|coeffs?|coefs|coefficients?)?|coeffs?|kc"  # kc: Bouguet's toolbox
SIDES = ("resolution", "camerares", "imagesize", "imgsize", "imageresolution")
# Keys that change the camera; not the matrices of rectified images in ROS's files
CAMERA_LIKE = (
    r".*((?<!un)distort|focal|intrinsic|cam(era)?ma?t(ri)?x|principal|mirrorparam).*|[kps]\d|"
    r"[fc][xyuv]|[muv][0uv]|xi|skew|fov[xy]?|mtx|im(a)?ge?(shape|dim).*|k|f|d|camera2.*|"
    rf"(radial|tangential).*|{DISTORTION}|{'|'.join(SIDES)}"
)


def _plain(key: str) -> str:
    """Return a key without a prefix of ORB-SLAM; if long, in small letters and digits alone."""
    key = re.sub(r"^Camera1?\.", "", str(key).replace("Camera.type", "model"))
    plain = re.sub(r"[^a-z0-9]", "", key.lower())
    return plain if len(plain) > 2 else key


def _flat(data: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Return values, and keys as they are written, by `_plain`; also those of nested cameras."""
    values: dict[str, Any] = {}
    written: dict[str, str] = {}
    for key, value in data.items():
        plain = _plain(key)
        is_group = isinstance(value, dict) and "data" not in value
        if is_group and re.fullmatch(f"cam(era)?|.*parameters|{CAMERA_LIKE}", plain):
            inner = _flat(value)
            values |= inner[0]
            written |= inner[1]
        else:
            values[plain] = value
            written[plain] = str(key)
    return values, written


def _take(keys: dict[str, Any], *names: str) -> Any:
    """Remove the first of the names that is a key; return its value, or None."""
    return next((keys.pop(name) for name in names if name in keys), None)


def _numbers(value: Any) -> list[float]:
    """Return the numbers in a value, nested or under `data`; [] of anything else."""
    value = value.get("data") if isinstance(value, dict) else value
    try:
        return [] if value is None else np.array(value, np.float64).ravel().tolist()
    except (TypeError, ValueError):
        return []


def _terms(keys: dict[str, Any], *names: str) -> list[float]:
    """Take the distortion in the order of its names: by name, or from a list; else 0."""
    found = [key for key in keys if key == "D" or re.fullmatch(DISTORTION, key)]
    values = _numbers(_take(keys, *found))
    if any(values[len(names) :]):
        raise ReobjError(f"{len(values)} distortion coefficients; expected {','.join(names)}")
    listed = [*values, *[0.0] * len(names)]
    pairs = zip(names, listed, strict=False)
    return [float(keys.pop(name, value)) for name, value in pairs]


def _brown_terms(keys: dict[str, Any]) -> list[float]:
    """Take the terms of OpenCV's model; refuse a k4 that may be one of a fisheye lens."""
    if "k" in keys:  # of SIMPLE_RADIAL
        keys["k1"] = keys.pop("k")
    if not {"k5", "k6"} & keys.keys() and any(_numbers(keys.get("k4"))):
        raise ReobjError("k4 without k5 and k6: of a fisheye lens (camera_model OPENCV_FISHEYE), "
                         "or of OpenCV's rational model (k5 and k6 too, if 0)")  # fmt: skip
    return _terms(keys, "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def _pinhole(keys: dict[str, Any], size: Size) -> tuple[float, ...] | None:
    """Take fx, fy, cx, cy, or a matrix; None without a focal length."""
    matrix = _take(keys, "cameramatrix", "K", "intrinsicmatrix", "mtx", "intrinsics", "intrinsic")
    if matrix is not None:
        return _focal_and_centre(_numbers(matrix))
    fx = _take(keys, "fx", "flx", "f", "focal")
    fy = _take(keys, "fy", "fly")
    centre = [_take(keys, "cx", "ppx"), _take(keys, "cy", "ppy")]
    angle = _take(keys, "cameraanglex")
    if fx is None and angle is not None and size:
        if not 0 < float(angle) < math.pi:
            raise ReobjError(f"camera_angle_x {angle}, expected radians between 0 and pi")
        fx = 0.5 * size[0] / math.tan(0.5 * float(angle))
    if fx is None:
        return None
    if centre == [None, None]:
        centre = [0.5 * side for side in _sized(size)]
    return tuple(map(float, (fx, fx if fy is None else fy, *centre)))


def _lens(keys: dict[str, Any]) -> str:
    """Take the name of the lens model, in capitals; "" without one.

    Raises:
        ReobjError: neither a model of pycolmap, nor one of FISHEYE and BROWN.
    """
    model = str(_take(keys, "cameramodel", "model", "modeltype") or "").upper()
    lens = str(_take(keys, "distortionmodel") or "").upper()  # of ROS and Kalibr
    model = lens if model in ("", "PINHOLE") and lens else model
    model = re.sub("[ -]", "_", model.removeprefix("DISTORTION."))  # of RealSense
    if re.fullmatch("(INVERSE|MODIFIED)_BROWN_CONRADY", model):
        distorted = any(_numbers(keys.get("coeffs")))
        model = model if distorted else "BROWN_CONRADY"
    if model not in (*FISHEYE, *BROWN):
        camera_parameters(model)  # refuses unknown ones
    return model


def _refuse_unread(keys: dict[str, Any], written: dict[str, str], camera: Camera) -> None:
    """Refuse a key that is left, has a number that is not the camera's, and changes cameras."""
    for plain, value in keys.items():
        key = written[plain]
        repeated = () if key[1:].isdecimal() else camera.params  # not those of k1, p1
        lost = {*_numbers(value)} - {0.0, *repeated}
        if lost and re.fullmatch(CAMERA_LIKE, plain, re.IGNORECASE):
            raise ReobjError(
                f"{key!r} is not read; expected fx, fy, cx, cy or a matrix K, k1, k2, p1, p2, k3 "
                "or a list dist_coeffs in OpenCV's order, width, height"
            )


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
    keys, written = _flat(data[rigs[0]] if rigs else data)
    if len(_numbers(keys.get("k"))) == 9:  # ROS 2: as K and D of ROS 1
        keys |= {name.upper(): keys.pop(name) for name in ("k", "d") if name in keys}
        written |= {"K": "k", "D": "d"}
    sides = _numbers(_take(keys, *SIDES)) or [
        _take(keys, letter, letter.upper(), word, f"image{word}", f"img{word}")
        for letter, word in (("w", "width"), ("h", "height"))
    ]
    size = size if None in sides else (image_side(sides[0]), image_side(sides[1]))
    model = _lens(keys)
    params = _take(keys, "params")
    if model and params is not None:
        camera = colmap_camera([model, *map(str, (*_sized(size), *params))])
    elif (pinhole := _pinhole(keys, size)) is None:
        return None
    elif str(_take(keys, "isfisheye", "fisheyemodel")).lower() in ("true", "1") or model in FISHEYE:
        terms = _terms(keys, "k1", "k2", "k3", "k4")
        camera = Camera("OPENCV_FISHEYE", *_sized(size), (*pinhole, *terms))
    elif model in BROWN:
        camera = brown_camera(size, *pinhole, *_brown_terms(keys))
    else:
        known = dict(zip(("fx", "fy", "cx", "cy", "f"), (*pinhole, pinhole[0]), strict=True))
        names = camera_parameters(model)
        values = [known[name] if name in known else _take(keys, name) for name in names]
        if None in values:
            missing = names[values.index(None)]
            raise ReobjError(f"no {missing} of a {model} camera")
        camera = Camera(model, *_sized(size), tuple(map(float, values)))
    _refuse_unread(keys, written, camera)
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


def _text_rows(probe: Probe) -> list[list[str]]:
    """Return the words of the lines of a text file that is no YAML, JSON or XML."""
    marked = probe.suffix in (".pincam", ".yaml", ".yml") or not probe.lines
    return [] if marked or probe.lines[0][0] in "[{<%" else _rows("\n".join(probe.lines))


def is_kitti_calibration(probe: Probe) -> bool:
    """Test for lines `P0: ...` or `P_rect_00: ...` of 12 numbers."""
    return any(KITTI_LINE.fullmatch(line) for line in probe.lines)


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
           "any model with a focal length", lambda p: _is_model_line(_text_rows(p)), _read_rows,
           units=OWN_PX),
    Format("numbers", "one line `fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]`, OpenCV's order",
           lambda p: len(rows := _text_rows(p)) == 1 and not _is_model_line(rows)
           and not is_kitti_calibration(p), _read_rows, units=FRAME_PX),
    Format("kitti", "KITTI: `calib.txt` and `calib_cam_to_cam.txt`, `P0:` or `P_rect_00:`",
           is_kitti_calibration, _read_kitti, units=FRAME_PX, unread="images before rectification"),
    Format("matrix", "K.txt, ScanNet: matrix K, 3x3 or 4x4",
           lambda p: len(rows := _text_rows(p)) in (3, 4) and {*map(len, rows)} == {len(rows)},
           _read_rows, units=FRAME_PX),
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
