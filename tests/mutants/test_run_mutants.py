"""What the runner of the faults concludes from pytest's end."""

import signal

import pytest
from faults import Fault
from run_mutants import Outcome, Verdict, judged, report


@pytest.mark.parametrize(
    ("status", "output", "outcome", "words"),
    [
        (0, "12 passed", Outcome.SURVIVED, ""),
        (5, "no tests ran", Outcome.SURVIVED, "no test was selected"),
        (1, "FAILED tests/map/test_anchors.py::test_far - assert", Outcome.KILLED, "test_anchors.py::test_far"),
        (-signal.SIGXCPU, "", Outcome.KILLED, "SIGXCPU"),
        (None, "..", Outcome.TIMED_OUT, "not done after 900 s"),
    ],
)
def test_the_end_of_pytest_is_an_outcome(status, output, outcome, words):
    found, said = judged(status, output)
    assert found is outcome
    assert words in said


def test_a_failure_of_pytest_itself_is_no_kill():
    with pytest.raises(RuntimeError, match="status 3"):
        judged(3, "INTERNALERROR")


def verdicts(*outcomes, survives=""):
    fault = Fault("map", "a fault", "a", "b", "because", ["test_anchors.py"], survives=survives)
    return [Verdict(fault, outcome, 1.0, "") for outcome in outcomes]


def test_a_run_that_timed_out_counts_as_neither_and_fails_the_whole(capsys):
    assert report(verdicts(*[Outcome.KILLED] * 9)) == 0
    assert report(verdicts(*[Outcome.KILLED] * 9, Outcome.TIMED_OUT)) == 1
    assert "9 of 10 killed, 0 survived, 1 timed out" in capsys.readouterr().out


def test_one_survivor_in_ten_passes_if_a_sentence_explains_it(capsys):
    assert report(verdicts(*[Outcome.KILLED] * 9, Outcome.SURVIVED)) == 1
    assert report(verdicts(*[Outcome.KILLED] * 9, Outcome.SURVIVED, survives="it is twice safe")) == 0
    assert report(verdicts(*[Outcome.KILLED] * 8, *[Outcome.SURVIVED] * 2, survives="it is twice safe")) == 1
    capsys.readouterr()
