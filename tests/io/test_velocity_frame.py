import numpy as np
import pytest

from edgeslam_torch.io.telemetry_csv import TelemetryTable, detect_units, read_table
from edgeslam_torch.io.velocity_frame import body_frame_evidence


def flown(rng, noise=0.01):
    """A minute of flight that turns all the time and leans into its accelerations, in the SDK's axes and units."""
    t = np.arange(0.0, 60.0, 0.1)
    v = np.stack([0.8 * np.sin(0.9 * t), 0.7 * np.sin(0.7 * t + 1.0)], axis=1)
    a, yaw = np.gradient(v, 0.1, axis=0), 0.25 * t
    c, s = np.cos(yaw), np.sin(yaw)
    forward, right = c * a[:, 0] + s * a[:, 1], -s * a[:, 0] + c * a[:, 1]
    angles = np.degrees(np.stack([-np.arctan(forward / 9.81), np.arctan(right / 9.81), yaw], axis=1))
    angles = np.round(angles + rng.normal(0, 0.5, angles.shape))
    angles[:, 2] = (angles[:, 2] + 180.0) % 360.0 - 180.0
    told = np.round(10.0 * (v + rng.normal(0, noise, v.shape)))
    return t, dict(zip(("vgx", "vgy", "pitch", "roll", "yaw"), [*told.T, *angles.T], strict=True))


def turned_to_body(values):
    yaw = np.radians(values["yaw"])
    c, s, x, y = np.cos(yaw), np.sin(yaw), values["vgx"], values["vgy"]
    return {**values, "vgx": c * x + s * y, "vgy": -s * x + c * y}


def test_both_frames_are_told_apart_by_the_lean(rng):
    t, values = flown(rng)
    assert body_frame_evidence(t, values)[0] < -20
    assert body_frame_evidence(t, turned_to_body(values))[0] > 20


def test_a_log_in_body_axes_is_read_as_the_same_flight(rng):
    t, values = flown(rng)
    body = TelemetryTable(t, turned_to_body(values), 0)
    units = detect_units(body)
    assert units.body_frame
    for told, expected in zip(body.samples(units), TelemetryTable(t, values, 0).samples(), strict=True):
        np.testing.assert_allclose(told.velocity_m_s[:2], expected.velocity_m_s[:2], atol=1e-9)


def test_hover_and_missing_columns_say_nothing(rng):
    t, values = flown(rng)
    assert body_frame_evidence(t, {**values, "yaw": 0.0 * t})[0] == 0.0
    assert body_frame_evidence(t, {"vgx": values["vgx"]})[0] == 0.0
    assert body_frame_evidence(t, dict.fromkeys(values, np.nan * t))[0] == 0.0
    assert body_frame_evidence(t, dict.fromkeys(values, 0.0 * t))[0] == 0.0
    assert not detect_units(TelemetryTable(t, {**values, "yaw": 0.0 * t}, 0)).body_frame


@pytest.mark.data
@pytest.mark.parametrize("name", ["flight_a", "flight_b"])
def test_real_tellos_speak_of_the_world(data_dir, name):
    table = read_table(data_dir / "tello_telemetry" / f"{name}.csv")
    assert body_frame_evidence(table.stamps_s, table.values)[0] < -20
    units = detect_units(table)
    assert (units.velocity_m_s, units.z_down, units.body_frame) == (0.1, True, False)
