import numpy as np
import pytest

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.files.imu_files import write_imu
from edgeslam_torch.geometry import se3
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.readers.imu.find import Given, find_imu

T_IMU_CAM = se3.exp(np.array([0.1, 0.2, -0.1, 0.3, -0.8, 1.2]))
BEGIN_S = 1.4e9
ROWS = "".join(f"{round(1e9 * BEGIN_S) + 5_000_000 * i},0.1,0.2,0.3,9.7,1,0\n" for i in range(400))
HEADER = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z,a_RS_S_x [m s^-2],a_RS_S_y,a_RS_S_z\n"
NOISE = {"gyroscope_noise_density": 1.7e-4, "gyroscope_random_walk": 2e-5, "accelerometer_noise_density": 2e-3}
NOISE |= {"accelerometer_random_walk": 3e-3}


def rows_of(T):
    return str(T.tolist())


def text_of(**values):
    return "".join(f"{name.replace('__', '.')}: {value}\n" for name, value in values.items())


def found(folder, given=None, span=(BEGIN_S, BEGIN_S + 2.0)):
    return find_imu([folder], given or Given(), lambda: span)


def opencv(T):
    rows, columns = np.shape(T)
    numbers = ", ".join(map(repr, np.ravel(T).tolist()))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: f\n   data: [{numbers}]\n"


OURS = text_of(**NOISE, time_offset_s=0.03, T_imu_cam=rows_of(T_IMU_CAM))
MODELS = {
    "ours": {"imu.yaml": OURS},
    "kalibr": {
        "imu-a.yaml": "imu0:\n" + "".join(f"  {k}: {v}\n" for k, v in NOISE.items()) + "  update_rate: 200.0\n",
        "camchain-imucam-a.yaml": f"cam0:\n  T_cam_imu: {rows_of(se3.inverse(T_IMU_CAM))}\n  timeshift_cam_imu: 0.03\n"
        f"cam1:\n  T_cam_imu: {rows_of(np.eye(4))}\n  timeshift_cam_imu: 0.5\n",
    },
    "openvins": {
        "kalibr_imu_chain.yaml": "%YAML:1.0\nimu0:\n" + "".join(f"  {k}: {v}\n" for k, v in NOISE.items()),
        "kalibr_imucam_chain.yaml": f"%YAML:1.0\ncam0:\n  T_imu_cam: {rows_of(T_IMU_CAM)}\n  timeshift_cam_imu: 0.03\n",
    },
    "orb-slam3": {
        "camera.yaml": "%YAML:1.0\n"
        + "".join(
            f"IMU.{name}: {value}\n"
            for name, value in zip(("NoiseGyro", "GyroWalk", "NoiseAcc", "AccWalk"), NOISE.values(), strict=True)
        )
        + f"IMU.Frequency: 200.0\nIMU.T_b_c1: {opencv(T_IMU_CAM)}"
    },
    "vins-fusion": {"camera.yaml": f"%YAML:1.0\nacc_n: 0.1\ngyr_n: 0.01\ntd: 0.03\nbody_T_cam0: {opencv(T_IMU_CAM)}"},
    "vins-mono": {
        "camera.yaml": f"%YAML:1.0\nacc_n: 0.1\ngyr_n: 0.01\ntd: 0.03\nextrinsicRotation: {opencv(T_IMU_CAM[:3, :3])}"
        f"extrinsicTranslation: {opencv(T_IMU_CAM[:3, 3:])}"
    },
}


@pytest.mark.parametrize("files", MODELS.values(), ids=MODELS)
def test_calibrations_of_other_programs_give_the_same_model(tmp_path, files):
    (tmp_path / "imu.csv").write_text(HEADER + ROWS)
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    model, readings, _said = found(tmp_path)
    assert model.T_imu_cam == pytest.approx(T_IMU_CAM, abs=1e-9)
    assert model.time_offset_s in (0.03, None)
    assert model.rate_hz == pytest.approx(200, rel=1e-3) and len(readings) == 400
    if "acc_n" in "".join(files.values()):  # standard deviations of single readings
        assert model.accelerometer_noise_density == pytest.approx(0.1 / np.sqrt(200), rel=1e-3)
    else:
        assert {name: getattr(model, name) for name in NOISE} == NOISE


def test_euroc_mount_is_the_relative_pose_of_both_sensors(tmp_path):
    T_body_imu = se3.exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.5]))
    sensors = {"imu0": T_body_imu, "cam0": T_body_imu @ T_IMU_CAM}
    for name, T in sensors.items():
        (tmp_path / "mav0" / name).mkdir(parents=True)
        noise = text_of(**NOISE, rate_hz=200) if name == "imu0" else "rate_hz: 20\n"
        matrix = f"T_BS:\n  cols: 4\n  rows: 4\n  data: {np.ravel(T).tolist()}\n"
        (tmp_path / "mav0" / name / "sensor.yaml").write_text(noise + matrix)
    (tmp_path / "mav0" / "imu0" / "data.csv").write_text(HEADER + ROWS)
    for folders in ([tmp_path, tmp_path / "mav0" / "cam0"], [tmp_path / "mav0" / "cam0"]):
        model, readings, said = find_imu(folders, Given(), lambda: (BEGIN_S, BEGIN_S + 2.0))
        assert model.T_imu_cam == pytest.approx(T_IMU_CAM, abs=1e-9)
        assert model.time_offset_s == 0.0 and len(readings) == 400 and not said


def test_kinect_readings_have_a_mount_and_no_gyroscope(tmp_path):
    (tmp_path / "accelerometer.txt").write_text("# timestamp ax ay az\n10.0 1 9 3\n10.01 1 9 3\n")
    model, readings, said = found(tmp_path, span=(10.0, 10.0))
    assert (readings.acceleration_m_s2[0] @ model.T_imu_cam[:3, :3]).tolist() == [-1, -9, 3]
    assert not readings.has_gyroscope and not said
    (tmp_path / "mine.yaml").write_text(OURS)
    assert found(tmp_path, Given(model=tmp_path / "mine.yaml"), (9.9, 10.1))[0].time_offset_s == 0.03


@pytest.mark.parametrize(
    "model", ["", "T_imu_cam: 3\n", "T_imu_cam: [[1]]\n", "T_cam_imu: 0\n", "gyr_n: -1\n", "td: x\n"]
)
def test_an_invalid_model_is_said_and_the_imu_not_used(tmp_path, model):
    (tmp_path / "imu.csv").write_text(HEADER + ROWS)
    (tmp_path / "imu.yaml").write_text(model)
    none, readings, (said,) = found(tmp_path)
    assert none is None and readings is None and "imu.yaml" in said
    with pytest.raises(EdgeSlamError, match=r"imu\.yaml"):
        found(tmp_path, Given(model=tmp_path / "imu.yaml"))


@pytest.mark.parametrize("span", [(0.0, 60.0), (BEGIN_S + 3600.0, BEGIN_S + 3660.0), (0.0, float("inf"))])
def test_readings_of_another_flight_or_clock_are_not_used(tmp_path, span):
    (tmp_path / "imu.csv").write_text(HEADER + ROWS)
    none, readings, (said,) = found(tmp_path, span=span)
    assert none is None and readings is None and "stamped" in said
    with pytest.raises(EdgeSlamError, match="stamped"):
        found(tmp_path, Given(readings=tmp_path / "imu.csv"), span)


def test_written_files_give_the_same_readings_and_model(tmp_path, rng):
    stamps_s = BEGIN_S + 0.005 * np.arange(400)
    force = rng.standard_normal((400, 3)) + [0, 0, 9.81]
    readings = ImuReadings(stamps_s, rng.standard_normal((400, 3)), force)
    wanted = ImuModel(**NOISE, rate_hz=200.0, T_imu_cam=T_IMU_CAM, time_offset_s=0.01)
    write_imu(tmp_path, readings, wanted)
    model, read, said = found(tmp_path)
    assert not said and read.stamps_s == pytest.approx(stamps_s, abs=1e-6)
    assert read.angular_rate_rad_s.tolist() == readings.angular_rate_rad_s.tolist()
    assert read.acceleration_m_s2.tolist() == force.tolist()
    assert (model.T_imu_cam == T_IMU_CAM).all() and model.time_offset_s == 0.01


def test_without_an_imu_there_is_no_warning_and_what_is_not_stated_of_one_is_left_to_estimation(tmp_path):
    assert found(tmp_path) == (None, None, [])
    with pytest.raises(EdgeSlamError, match="readings"):
        found(tmp_path, Given(model=tmp_path / "imu.yaml"))
    (tmp_path / "imu.csv").write_text(HEADER + ROWS)
    model, _, said = found(tmp_path)
    assert model.T_imu_cam is None and model.time_offset_s is None and model.source == ImuModel().source
    assert len(said) == 2 and "noise" in said[0] and "mount and clock" in said[1]


def test_given_files_come_before_those_of_the_folder(tmp_path):
    (tmp_path / "imu.csv").write_text(HEADER + ROWS)
    (tmp_path / "imu.yaml").write_text(OURS)
    (tmp_path / "other.csv").write_text(HEADER + ROWS[: len(ROWS) // 2].rpartition("\n")[0] + "\n")
    (tmp_path / "other.yaml").write_text(text_of(time_offset_s=0.01))
    given = Given(tmp_path / "other.csv", tmp_path / "other.yaml")
    model, readings, said = found(tmp_path, given)
    assert len(readings) < 250 and model.time_offset_s == 0.01 and model.T_imu_cam is None
    assert any("missing for 1.0 s" in line for line in said)
