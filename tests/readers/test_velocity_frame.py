import numpy as np
import pytest

from edgeslam_torch.readers.telemetry_csv import TelemetryTable, detect_units, read_table
from edgeslam_torch.readers.velocity_frame import body_frame_evidence


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


def test_both_frames_are_distinguished_by_the_lean(rng):
    t, values = flown(rng)
    assert body_frame_evidence(t, values)[0] < -20
    assert body_frame_evidence(t, turned_to_body(values))[0] > 20


@pytest.mark.parametrize("lean_deg", [-23.0, 10.0])
@pytest.mark.parametrize("body", [False, True])
def test_a_body_mounted_at_an_angle_does_not_decide_the_frame(rng, lean_deg, body):
    """The constant part of the lean is no acceleration; turned by yaw it would drown the rest."""
    t, values = flown(rng)
    values = {**values, "pitch": values["pitch"] + lean_deg, "roll": values["roll"] - 0.5 * lean_deg}
    ratio = body_frame_evidence(t, turned_to_body(values) if body else values)[0]
    assert ratio > 20 if body else ratio < -20


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
@pytest.mark.parametrize("lean_deg", [0.0, -23.0])
@pytest.mark.parametrize("name", ["flight_a", "flight_b"])
def test_real_flights_in_body_or_leaning_axes_are_distinguished(data_dir, name, lean_deg):
    table = read_table(data_dir / "tello_telemetry" / f"{name}.csv")
    assert not detect_units(table).body_frame
    t = table.stamps_s - table.stamps_s[0]
    values = {**table.values, "pitch": table.values["pitch"] + lean_deg}
    assert body_frame_evidence(t, values)[0] < -15
    assert body_frame_evidence(t, turned_to_body(values))[0] > 15
    for begin in np.arange(0.0, t[-1] - 60.0, 20.0):  # no stretch looks like the other frame
        part = (t >= begin) & (t < begin + 60.0)
        assert body_frame_evidence(t[part], {k: x[part] for k, x in table.values.items()})[0] <= 0.0
