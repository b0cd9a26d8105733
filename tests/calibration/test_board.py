import cv2
import numpy as np
import pytest

from edgeslam_torch.calibration.board import Board, board_size, calibrate
from edgeslam_torch.cli import main
from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import load_camera

CAMERA = Camera(640, 480, 520.0, 518.0, 315.0, 243.0)


def chessboard(columns=8, rows=6, pixels=60):
    """Picture of a printed board with its white border."""
    x, y = np.meshgrid(np.arange((columns + 3) * pixels), np.arange((rows + 3) * pixels))
    inside = (x >= pixels) & (x < (columns + 2) * pixels) & (y >= pixels) & (y < (rows + 2) * pixels)
    return np.where(inside & ((x // pixels + y // pixels) % 2 == 0), 20, 235).astype(np.uint8)


def views(rng, picture, count, camera=CAMERA, width_m=0.30):
    """Photographs of a flat picture from many sides, by homography."""
    scale = width_m / picture.shape[1]
    to_board = np.diag([scale, scale, 1.0])
    to_board[:2, 2] = [-0.5 * width_m, -0.5 * scale * picture.shape[0]]
    for k in range(count):
        turn = cv2.Rodrigues(rng.uniform([-0.6, -0.6, -0.4], [0.6, 0.6, 0.4]))[0]
        place = np.array([rng.uniform(-0.07, 0.07), rng.uniform(-0.05, 0.05), rng.uniform(0.36, 0.5)])
        H = camera.K @ np.column_stack([turn[:, 0], turn[:, 1], place]) @ to_board
        image = cv2.warpPerspective(picture, H, (camera.width, camera.height), flags=cv2.INTER_AREA, borderValue=150)
        yield f"view{k}.png", cv2.GaussianBlur(image, (0, 0), 0.7)


def test_camera_of_rendered_chessboards_is_found(rng):
    result = calibrate(views(rng, chessboard(), 14), Board(8, 6))
    camera = result.camera
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.005)
    assert 1e-4 < camera.focal_sigma < 0.02 and abs(camera.fx / CAMERA.fx - 1.0) < 4.0 * camera.focal_sigma
    assert camera.fy == pytest.approx(CAMERA.fy, rel=0.005)
    assert camera.cx == pytest.approx(CAMERA.cx, abs=3.0)
    assert camera.cy == pytest.approx(CAMERA.cy, abs=3.0)
    assert result.rms_px < 0.2
    assert len(result.used) >= 10


def test_charuco_board_is_found_even_when_partly_out_of_sight(rng):
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    picture = cv2.aruco.CharucoBoard((9, 7), 0.025, 0.018, dictionary).generateImage((900, 700), marginSize=30)
    result = calibrate(views(rng, picture, 12, width_m=0.4), Board(9, 7, charuco=True))
    assert result.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert result.rms_px < 0.5


def aprilgrid(columns=6, rows=5, side=100, gap=30, border=2, upwards=True):
    """Kalibr's board: tags with black squares between their corners."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pitch = side + gap
    picture = np.full((rows * pitch + 3 * gap, columns * pitch + 3 * gap), 255, np.uint8)
    for y in range(rows + 1):
        for x in range(columns + 1):
            picture[gap + y * pitch : 2 * gap + y * pitch, gap + x * pitch : 2 * gap + x * pitch] = 0
    for number in range(columns * rows):
        row, x = divmod(number, columns)
        y = rows - 1 - row if upwards else row
        tag = cv2.aruco.generateImageMarker(dictionary, number, side, borderBits=border)
        corner = 2 * gap + y * pitch, 2 * gap + x * pitch
        picture[corner[0] : corner[0] + side, corner[1] : corner[1] + side] = tag
    return picture


@pytest.mark.parametrize(("border", "upwards", "turned"), [(1, False, 0), (2, True, 2)])
def test_aprilgrid_is_found_whatever_its_order_and_border(rng, border, upwards, turned):
    picture = np.rot90(aprilgrid(border=border, upwards=upwards), turned)
    result = calibrate(views(rng, picture, 6, width_m=0.4), Board(6, 5, tag_spacing=0.3))
    assert result.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert result.rms_px < 0.3


@pytest.mark.parametrize("kind", ["video", "recording"])
def test_a_video_and_a_recording_are_calibrated(rng, tmp_path, kind):
    pictures = [image for _, image in views(rng, chessboard(), 8)]
    source = tmp_path / "clip.avi"
    if kind == "video":
        writer = cv2.VideoWriter(str(source), cv2.VideoWriter.fourcc(*"MJPG"), 2, (640, 480))
        for image in pictures:
            writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
        writer.release()
    else:
        source = tmp_path / "flight"
        (source / "rgb").mkdir(parents=True)
        for i, image in enumerate(pictures):
            cv2.imwrite(str(source / "rgb" / f"{i}.png"), image)
        (source / "rgb.txt").write_text("".join(f"{0.6 * i} rgb/{i}.png\n" for i in range(len(pictures))))
        (source / "camera.yaml").write_text("is not needed: yet\n")
    assert main(["calibrate", str(source), "--board", "8x6", "--out", str(tmp_path / "c.yaml")]) == 0
    camera = load_camera(tmp_path / "c.yaml")
    assert camera.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert camera.focal_sigma > 0


def test_bad_pictures_are_left_out_by_name_and_reason(rng):
    good = list(views(rng, chessboard(), 9))
    pictures = [
        *good,
        ("twin.png", good[0][1]),
        ("wall.png", np.full((480, 640), 120, np.uint8)),
        ("small.png", np.zeros((240, 320), np.uint8)),
    ]
    rejected = calibrate(pictures, Board(8, 6)).rejected
    assert "same view as view0.png" in rejected["twin.png"]
    assert "no 8x6 board" in rejected["wall.png"]
    assert "320x240" in rejected["small.png"]


def test_few_or_flat_views_are_doubted(rng):
    flat = Camera(640, 480, 520.0, 518.0, 315.0, 243.0)
    board = chessboard()
    scale = 0.2 / board.shape[1]
    pictures = []
    for k in range(5):
        H = flat.K @ np.array([[scale, 0, -0.14 + 0.02 * k], [0, scale, -0.1 + 0.01 * k], [0, 0, 0.4 + 0.03 * k]])
        pictures.append((f"flat{k}", cv2.warpPerspective(board, H, (640, 480), borderValue=150)))
    with pytest.raises(CalibrationError, match="cannot be.*photograph the board tilted"):
        calibrate(pictures, Board(8, 6))


@pytest.mark.parametrize(
    "arguments", [["nowhere"], ["--board", "8by6"], ["--board", "8x6", "--charuco", "9x7"], ["--aprilgrid", "1x1"]]
)
def test_command_refuses_in_one_line(arguments, tmp_path, capsys):
    given = arguments if arguments == ["nowhere"] else [str(tmp_path), *arguments]
    assert main(["calibrate", *given, "--out", str(tmp_path / "c.yaml")]) == 1
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.slow
@pytest.mark.data
def test_a_real_tello_is_calibrated_as_ros_did(data_dir):
    """26 of the 101 pictures that ost.yaml rests on: 1 %, 8 px and 0.4 px."""
    folder = data_dir / "tello_calibration"
    pictures = [(p.name, cv2.imread(str(p), cv2.IMREAD_GRAYSCALE)) for p in sorted(folder.glob("*.png"))]
    result = calibrate(pictures, Board())
    theirs = load_camera(folder / "ost.yaml")
    assert (result.board.columns, result.board.rows) == (8, 6)
    assert result.camera.fx == pytest.approx(theirs.fx, rel=0.01)
    assert result.camera.fy == pytest.approx(theirs.fy, rel=0.01)
    assert result.camera.cx == pytest.approx(theirs.cx, abs=8.0)
    assert result.camera.cy == pytest.approx(theirs.cy, abs=8.0)
    assert result.rms_px <= 0.4
    assert result.coverage > 0.8


def test_size_of_the_board_is_found_by_trying(rng):
    pictures = [image for _, image in views(rng, chessboard(7, 5), 3)]
    assert board_size(pictures) == (7, 5)


def test_a_picture_that_moved_is_left_out(rng):
    good = list(views(rng, chessboard(), 12))
    shear = np.array([[1.0, 0.06, 0.0], [0.0, 1.0, 0.0]])  # what a rolling shutter makes of a quick turn
    moved = cv2.warpAffine(good[3][1], shear, (640, 480), borderValue=150)
    pictures = [*good[:3], ("moved.png", moved), *good[4:]]
    result = calibrate(pictures, Board(8, 6))
    assert "its corners miss" in result.rejected["moved.png"]
    assert result.camera.fx == pytest.approx(CAMERA.fx, rel=0.01)


@pytest.mark.parametrize("wrong", [{"columns": 2, "rows": 6}, {"square_m": 0.0}, {"charuco": True}])
def test_impossible_boards_are_refused(wrong):
    with pytest.raises(CalibrationError):
        Board(**wrong)


def test_pictures_that_cannot_be_read_are_named_when_too_few_are_left(tmp_path, capsys):
    (tmp_path / "bomb.pgm").write_bytes(b"P5 17000 17000 255\n")
    assert main(["calibrate", str(tmp_path), "--board", "8x6", "--out", str(tmp_path / "c.yaml")]) == 1
    said = capsys.readouterr().err
    assert "1 could not be read (the first: " in said
    assert "bomb.pgm: image is 17000x17000" in said
