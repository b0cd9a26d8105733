"""Camera calibration from pictures of a chessboard, ChArUco board or AprilGrid (Zhang 2000, by OpenCV)."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.lens import check_camera, unique_share
from edgeslam_torch.types import FloatArray, IntArray

_COMMON = ((9, 6), (8, 6), (10, 7), (9, 7), (11, 8), (8, 5), (7, 6), (7, 5), (6, 5), (6, 4), (5, 4))
"""Inner corners of common boards, tried when the size is not given."""
_MIN_PICTURES = 4
_MAX_VIEWS = 80
"""Views of a long video that are used, evenly spaced; the solver's time grows with their number."""
_GRID = (8, 6)
"""Grid of cells for measuring coverage."""
_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
"""End of the refinement of corners [iterations, px]."""
_MIN_CHARUCO = 8
_MIN_TAGS = 4
_GROUPS = 5
"""Groups of images left out in turn (jackknife) to estimate the uncertainty of the focal length."""


@dataclass(frozen=True, slots=True)
class Board:
    """A printed pattern."""

    columns: int = 0
    """Chessboard: inner corners across; ChArUco: squares across; AprilGrid: tags across. 0 detects a chessboard's
    size."""
    rows: int = 0
    square_m: float = 0.025
    """Side of a square; intrinsics do not depend on it."""
    charuco: bool = False
    marker_m: float = 0.018
    dictionary: str = "DICT_5X5_100"
    """Name of OpenCV's ArUco dictionary (ChArUco only)."""
    tag_spacing: float = 0.0
    """AprilGrid (Kalibr's, tags 36h11): gap between tags relative to their side, which is `square_m`; 0 for the other
    boards."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.tag_spacing <= 2.0:
            raise CalibrationError(f"the gap between tags relative to their side is 0 to 2, got {self.tag_spacing:g}")
        if self.tag_spacing > 0.0 and min(self.columns, self.rows) < 2:
            raise CalibrationError("an AprilGrid needs its number of tags, 2x2 at least")
        if self.tag_spacing == 0.0 and (self.columns, self.rows) != (0, 0) and min(self.columns, self.rows) < 3:
            raise CalibrationError(f"a board of {self.columns}x{self.rows} is too small; 3x3 at least")
        if self.square_m <= 0 or (self.charuco and not 0 < self.marker_m < self.square_m):
            raise CalibrationError("a board's square must be positive and larger than its marker")
        if self.charuco and (self.columns == 0 or not hasattr(cv2.aruco, self.dictionary)):
            raise CalibrationError("ChArUco needs the number of squares and one of OpenCV's dictionaries, DICT_5X5_100")


@dataclass(frozen=True, slots=True)
class View:
    """Detected corners of one picture."""

    name: str
    uv: FloatArray
    """``(N, 2)`` corners [px], float32."""
    p_board: FloatArray
    """``(N, 3)`` the same corners on the board [m], float32."""


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """Result of a calibration with its quality."""

    camera: Camera
    rms_px: float
    """RMS distance between detected and predicted corners."""
    sigma: dict[str, float]
    """Standard deviations of fx fy cx cy [px]."""
    used: dict[str, float]
    """RMS of each picture [px]."""
    rejected: dict[str, str]
    """Reason for each rejected picture."""
    coverage: float
    """Share of the cells (8 x 6) that contain a corner."""
    tilt_deg: float
    """Maximum angle between board and image plane; below 20 the focal length is poorly constrained."""
    board: Board
    warnings: list[str] = field(default_factory=list)


def board_size(pictures: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Inner corners of the chessboard found in most of the grey pictures; None without a common size."""
    for size in _COMMON:
        if any(_chessboard(_shrunk(picture), size, exact=False) is not None for picture in pictures):
            return size
    return None


def find_board(name: str, grey: np.ndarray, board: Board) -> View | None:
    """Corners of the board in one grey picture ``(H, W)``, to a tenth of a pixel; None if it is not completely
    visible."""
    if board.charuco:
        return _find_charuco(name, grey, board)
    if board.tag_spacing > 0.0:
        return _find_aprilgrid(name, grey, board)
    uv = _chessboard(grey, (board.columns, board.rows), exact=True)
    if uv is None:
        return None
    grid = np.stack(np.meshgrid(np.arange(board.columns), np.arange(board.rows)), axis=-1).reshape(-1, 2)
    p = np.column_stack([grid * board.square_m, np.zeros(len(grid))]).astype(np.float32)
    return View(name, uv, p)


def _shrunk(grey: np.ndarray, width: int = 640) -> np.ndarray:
    if grey.shape[1] <= width:
        return grey
    height = round(grey.shape[0] * width / grey.shape[1])
    return cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)


def _chessboard(grey: np.ndarray, size: tuple[int, int], exact: bool) -> FloatArray | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH + cv2.CALIB_CB_NORMALIZE_IMAGE + (0 if exact else cv2.CALIB_CB_FAST_CHECK)
    if min(grey.shape) < 32:
        return None
    found, seen = cv2.findChessboardCorners(grey, size, flags=flags)
    if not found:
        return None
    corners: FloatArray = np.asarray(seen, dtype=np.float32)
    if not exact:
        return corners.reshape(-1, 2)
    uv = corners.reshape(size[1], size[0], 2)
    spacing = min(_min_distance(uv, 0), _min_distance(uv, 1))
    # As wide as possible without reaching the next corner: on 26 pictures of a real Tello, half the spacing gives
    # 0.32 px RMS, a fifth of it 0.70 px.
    half = int(np.clip(0.5 * spacing, 2, 30))
    refined = cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), _CRITERIA)
    return np.asarray(refined, dtype=np.float32).reshape(-1, 2)


def _min_distance(uv: FloatArray, axis: int) -> float:
    return float(np.min(np.linalg.norm(np.diff(uv, axis=axis), axis=-1)))


def _find_charuco(name: str, grey: np.ndarray, board: Board) -> View | None:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    pattern = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(grey)
    if ids is None or len(ids) < _MIN_CHARUCO:
        return None
    p = np.asarray(pattern.getChessboardCorners(), dtype=np.float32)[np.asarray(ids).ravel()]
    return View(name, np.asarray(corners, dtype=np.float32).reshape(-1, 2), p)


def _find_aprilgrid(name: str, grey: np.ndarray, board: Board) -> View | None:
    """Corners of the visible tags of Kalibr's AprilGrid.

    Whether ids count from the lower or the upper row, and which corner of a tag comes first, differs between
    programs; a homography decides.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for border in (2, 1):  # Kalibr prints two bits of border, others one
        parameters = cv2.aruco.DetectorParameters()
        parameters.markerBorderBits = border
        corners, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(grey)
        number = np.zeros(0, int) if ids is None else np.asarray(ids, int).ravel()
        kept = number < board.columns * board.rows
        if np.count_nonzero(kept) >= _MIN_TAGS:
            break
    else:
        return None
    number = number[kept]
    uv = np.asarray(corners, dtype=np.float32).reshape(-1, 4, 2)[kept]
    # The gaps' black squares touch the tags' corners: a third of the gap reaches no other edge.
    side = float(np.median(np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2)))
    half = int(np.clip(side * board.tag_spacing / 3.0, 2, 10))
    refined = cv2.cornerSubPix(grey, uv.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), _CRITERIA)
    exact: FloatArray = np.asarray(refined, dtype=np.float64).reshape(-1, 2)
    places = [_aprilgrid_corners(number, board, first, up) for first in range(4) for up in (True, False)]
    misses = [_homography_miss(place[:, :2], exact) for place in places]
    return View(name, exact.astype(np.float32), places[int(np.argmin(misses))].astype(np.float32))


def _aprilgrid_corners(number: IntArray, board: Board, first: int, upwards: bool) -> FloatArray:
    """Corners ``(4 N, 3)`` [m] of tags on the board, y down."""
    pitch = board.square_m * (1.0 + board.tag_spacing)
    row = number // board.columns
    place = np.stack([number % board.columns, board.rows - 1 - row if upwards else row], axis=1) * pitch
    corner = np.roll([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], first, axis=0) * board.square_m
    flat: FloatArray = (place[:, None] + corner).reshape(-1, 2)
    return np.column_stack([flat, np.zeros(len(flat))])


def _homography_miss(p: FloatArray, uv: FloatArray) -> float:
    """RMS [px] by which the best homography misses."""
    H, _ = cv2.findHomography(p, uv, 0)
    if H is None:
        return np.inf
    there = cv2.perspectiveTransform(p.reshape(-1, 1, 2), H).reshape(-1, 2)
    return float(np.sqrt(np.mean((there - uv) ** 2)))


def calibrate(
    pictures: Iterable[tuple[str, np.ndarray]], board: Board, source: str = "calibration"
) -> CalibrationResult:
    """Intrinsics and distortion from pictures.

    Pictures without the board, of another size, that repeat another view, or whose corners are outliers are rejected
    with a reason.

    Args:
        pictures: Name and grey picture ``(H, W)``, all of one camera.
        board: Pattern in the pictures.
        source: For the calibration file.

    Raises:
        CalibrationError: If fewer than four pictures are usable, or the result makes no sense.
    """
    rejected: dict[str, str] = {}
    views: list[View] = []
    size: tuple[int, int] | None = None
    for name, grey in pictures:
        here = (grey.shape[1], grey.shape[0])
        if size is not None and here != size:
            rejected[name] = f"is {here[0]}x{here[1]}, the first picture is {size[0]}x{size[1]}"
            continue
        size = here
        if board.columns == 0:
            found = board_size([grey])
            if found is None:
                rejected[name] = "no chessboard of a common size found"
                continue
            board = Board(*found, square_m=board.square_m, marker_m=board.marker_m)
        view = find_board(name, grey, board)
        if view is None:
            rejected[name] = f"no {board.columns}x{board.rows} board found, or not all of it"
            continue
        twin = next((v.name for v in views if _same_view(v, view)), None)
        if twin is not None:
            rejected[name] = f"the same view as {twin}"
            continue
        views.append(view)
    if size is None or len(views) < _MIN_PICTURES:
        seen = "; ".join(f"{name}: {reason}" for name, reason in list(rejected.items())[:3]) or "no picture was read"
        raise CalibrationError(
            f"{len(views)} usable pictures, {_MIN_PICTURES} are the least (20 are good); {seen}; "
            "give the inner corners with --board COLUMNSxROWS"
        )
    kept = np.unique(np.linspace(0, len(views) - 1, min(len(views), _MAX_VIEWS)).round().astype(int))
    return _solve([views[i] for i in kept], size, board, rejected, source)


def _same_view(a: View, b: View) -> bool:
    return len(a.uv) == len(b.uv) and float(np.median(np.linalg.norm(a.uv - b.uv, axis=1))) < 2.0


def _solve(
    views: list[View], size: tuple[int, int], board: Board, rejected: dict[str, str], source: str
) -> CalibrationResult:
    while True:
        p = [np.ascontiguousarray(v.p_board, dtype=np.float32) for v in views]
        uv = [np.ascontiguousarray(v.uv, dtype=np.float32).reshape(-1, 1, 2) for v in views]
        try:
            # k3 stays zero: it matters only in the image corners, which a board seldom reaches.
            rms, K, distortion, turns, _, sigma, _, per_view = cv2.calibrateCameraExtended(
                p, uv, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
            )
        except cv2.error as error:
            raise CalibrationError(
                f"these pictures do not determine a camera: {' '.join(str(error).split())}"
            ) from error
        errors = np.asarray(per_view).ravel()
        limit = max(2.5 * float(np.median(errors)), 0.3)  # motion blur and the drone's rolling shutter
        worst = int(np.argmax(errors))
        if errors[worst] <= limit or len(views) <= _MIN_PICTURES:
            break
        rejected[views[worst].name] = (
            f"its corners miss by {errors[worst]:.2f} px, the others by {np.median(errors):.2f} px"
        )
        del views[worst]
    spread = np.asarray(sigma).ravel()
    camera = _camera_of(np.asarray(K, float), np.asarray(distortion, float).ravel()[:5], size, source)
    camera = replace(camera, focal_sigma=min(1.0, _focal_sigma(p, uv, size, float(spread[0]) / camera.fx)))
    tilt = max(float(np.degrees(np.arccos(min(1.0, abs(cv2.Rodrigues(r)[0][2, 2]))))) for r in turns)
    result = CalibrationResult(
        camera,
        float(rms),
        dict(zip(("fx", "fy", "cx", "cy"), (float(x) for x in spread[:4]), strict=True)),
        {v.name: float(e) for v, e in zip(views, errors, strict=True)},
        rejected,
        _coverage(views, size),
        tilt,
        board,
    )
    result.warnings.extend(_doubts(result))
    return result


def _focal_sigma(p: list[FloatArray], uv: list[FloatArray], size: tuple[int, int], formal: float) -> float:
    """Relative standard deviation of the focal length: the formal one, or a jackknife's over groups of pictures, which
    includes a bent board and moved pictures."""
    groups = min(_GROUPS, len(p) - _MIN_PICTURES + 1)
    found = []
    for group in range(groups if groups > 1 else 0):
        kept = [i for i in range(len(p)) if i % groups != group]
        if len(kept) < _MIN_PICTURES - 1:
            continue
        _, K, *_ = cv2.calibrateCamera(
            [p[i] for i in kept], [uv[i] for i in kept], size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3
        )
        found.append(float(np.log(max(K[0, 0], 1.0))))
    if len(found) < 2:
        return formal
    return max(formal, float(np.sqrt((len(found) - 1) * np.var(found))))


def _camera_of(K: FloatArray, distortion: FloatArray, size: tuple[int, int], source: str) -> Camera:
    try:
        fx, fy, cx, cy = (float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        camera = Camera(*size, fx, fy, cx, cy, tuple(float(k) for k in distortion), source)
        check_camera(camera)
    except CalibrationError as error:
        raise CalibrationError(
            f"these pictures give an impossible camera ({error}); photograph the board tilted, from all sides"
        ) from error
    return camera


def _coverage(views: list[View], size: tuple[int, int]) -> float:
    uv = np.concatenate([v.uv for v in views])
    cell = np.floor(uv / np.array(size) * np.array(_GRID)).astype(int)
    inside = np.all((cell >= 0) & (cell < np.array(_GRID)), axis=1)
    return len(np.unique(cell[inside], axis=0)) / (_GRID[0] * _GRID[1])


def _doubts(result: CalibrationResult) -> list[str]:
    doubts = []
    if result.rms_px > 1.0:
        doubts.append(f"the corners miss by {result.rms_px:.2f} px: is the board flat, and are the pictures sharp?")
    if result.coverage < 0.6:
        doubts.append(
            f"corners in {100 * result.coverage:.0f} % of the picture only: bring the board into all its corners"
        )
    if result.tilt_deg < 20.0:
        doubts.append(f"the board is tilted by {result.tilt_deg:.0f} degrees at most: tilt it by 30 and more")
    if result.sigma["fx"] > 0.01 * result.camera.fx:
        doubts.append(
            f"the focal length is known to {100 * result.sigma['fx'] / result.camera.fx:.1f} % only: more pictures"
        )
    share = unique_share(result.camera)
    if share < 1.0:
        doubts.append(f"the distortion turns back at {100 * share:.0f} % of the way to the border: fill the corners")
    if len(result.used) < 10:
        doubts.append(f"{len(result.used)} pictures: 20 are good")
    return doubts
