"""Where a lost frame may be found again: where the drone's sensors let it be."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.atlas.saved import BEFORE_S
from edgeslam_torch.fusion.prediction import PoseEstimate
from edgeslam_torch.geometry import se3
from edgeslam_torch.states.tracking import Tracking


def placed(x):
    """Camera-to-world pose at ``(x, 0, 0)``."""
    T_w_c = np.eye(4)
    T_w_c[0, 3] = x
    return T_w_c


class Flown:
    """Six keyframes along five units, the newest of which was tracked last; what it sees is two units away."""

    def __init__(self, sigma=0.01, earlier=False, between=np.inf):
        self.between = between
        stamps = [BEFORE_S if earlier and k < 3 else float(k) for k in range(6)]
        self.keyframes = {
            k: SimpleNamespace(
                id=k,
                centre_w=np.array([float(k), 0.0, 0.0]),
                stamp_s=stamps[k],
                anchor=np.zeros(int(k >= 4), dtype=np.int64),
            )
            for k in range(6)
        }
        self.piece_of = dict.fromkeys(range(6), 0)
        self.told = PoseEstimate(6.0, placed(5.0), sigma, 0.01, "filter")
        self.asked = []
        self.sees_again = {}
        """Anchors that the two newest keyframes share with others."""

    def system(self):
        slam_map = SimpleNamespace(
            keyframes=self.keyframes,
            resolve=lambda k: (k, np.eye(4)),
            shared_counts=lambda anchors: self.sees_again if len(anchors) else {},
            piece_of=self.piece_of.__getitem__,
            anchors=SimpleNamespace(p_w=np.array([[0.0, 0.0, 2.0], [5.0, 0.0, 2.0]])),
        )
        return SimpleNamespace(
            map=slam_map,
            tracker=SimpleNamespace(local_keyframes=lambda anchor: [self.keyframes[0]]),
            log=SimpleNamespace(
                records=[SimpleNamespace(keyframe_id=5)], replace=lambda *_: self.asked.append("moved")
            ),
            carried=lambda stamp_s: self.told,
            between=lambda piece, other: 0.0 if piece == other else self.between,
        )

    def finds(self, x, turned_deg=0.0):
        """The track that a relocaliser's find at ``(x, 0, 0)``, confirmed by earlier frames, comes to."""
        T_w_c = placed(x)
        T_w_c[:3, :3] = se3.exp(np.array([0, 0, 0, 0, 0, np.deg2rad(turned_deg)]))[:3, :3]
        track = SimpleNamespace(T_c_w=se3.inverse(T_w_c), anchor=np.array([0, 1]))
        found = SimpleNamespace(track=track, earlier=[1])
        state = SimpleNamespace(system=self.system(), relocaliser=SimpleNamespace(find=lambda *_: found))
        state._may_be_at = lambda *args: Tracking._may_be_at(state, *args)
        return Tracking.find(state, SimpleNamespace(index=7, stamp_s=6.0), None, [], None)


def test_a_frame_is_not_found_again_where_the_drone_cannot_have_come_to():
    """Two and a half units from where it was carried to, on a way of five; nor are the frames before it moved there."""
    flown = Flown()
    assert flown.finds(2.5) is None and flown.asked == []


@pytest.mark.parametrize(("x", "sigma", "may"), [(4.7, 0.01, True), (4.5, 0.01, False), (4.5, 0.1, True)])
def test_a_map_drifts_and_sensors_doubt(x, sigma, may):
    """Three percent of the way, a tenth of the depth, and three sigmas: .38 and .65 units."""
    assert (Flown(sigma).finds(x) is not None) == may


def test_a_way_that_leads_back_to_what_was_seen_before_is_short():
    """`blank_walls` 797: home again after forty metres, found again on the same wallpaper 1.3 m on."""
    flown = Flown()
    for k in range(6):
        flown.keyframes[k].centre_w = np.array([10.0 * k if k < 5 else 5.0, 0.0, 0.0])
    assert flown.finds(3.7) is not None, "a way of 75 units"
    flown.sees_again = {0: 30}
    assert flown.finds(3.7) is None, "a way of 5"
    assert flown.finds(4.7) is not None


def test_a_new_piece_is_no_farther_from_the_way_back_than_the_one_before():
    """The same, and a piece that begins there: its own unit is in doubt, not where the way before it led."""
    flown = Flown(between=0.01)
    flown.keyframes[4].centre_w = np.array([4.9, 0.0, 0.0])
    for k in range(1, 4):
        flown.keyframes[k].centre_w = np.array([10.0 * k, 0.0, 0.0])
    flown.piece_of[5] = 1
    assert flown.finds(3.7) is not None
    flown.sees_again = {0: 30}
    assert flown.finds(3.7) is None
    assert flown.finds(4.7) is not None


def test_a_frame_is_not_found_again_where_it_would_have_turned_as_the_drone_has_not():
    """Two sides of a room with the same shelves."""
    assert Flown().finds(5.0, turned_deg=15.0) is not None
    assert Flown().finds(5.0, turned_deg=90.0) is None


@pytest.mark.parametrize(("between", "may"), [(0.1, False), (0.5, True), (np.inf, True)])
def test_a_piece_that_the_drone_was_carried_to_is_where_it_was_carried_to(between, may):
    """`cluttered_room` 790: lost in a turn, a new piece of map, and found again three metres off, a quarter turned."""
    flown = Flown(between=between)
    flown.piece_of[5] = 1
    assert (flown.finds(3.2) is not None) == may


def test_images_decide_alone():
    """Without sensors, in a piece of map that nothing relates to, and in the map of an earlier flight."""
    flown = Flown()
    flown.told = None
    assert flown.finds(0.0) is not None
    flown = Flown()
    flown.piece_of[5] = 1
    assert flown.finds(0.0) is not None
    assert Flown(earlier=True).finds(0.0) is not None
