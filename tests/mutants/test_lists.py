"""The lists of faults fit the code: whoever moves or rewrites a line that one names hears of it at once."""

import pytest
from faults import Fault, FaultError, Source, applied, load, pytest_arguments, sources


def test_every_fault_changes_one_place_and_its_tests_exist():
    files = sources()
    faults = load()
    assert len(faults) >= 80
    for fault in faults:
        applied(fault, files)
        assert pytest_arguments(fault)
        assert fault.why


def test_names_are_unique():
    names = [fault.name for fault in load()]
    assert len(set(names)) == len(names)


@pytest.fixture
def files(tmp_path):
    first = "def area(a, b):\n    return a * b\n\n\nclass Box:\n    def area(self):\n        return self.a * self.b\n"
    second = "def volume(a, b, c):\n    return a * b * c\n"
    return [Source(tmp_path / "flat.py", first), Source(tmp_path / "solid.py", second)]


def fault(line, put, at=""):
    return Fault("room", "a fault", line, put, "because", ["test_lists.py"], at)


def test_the_line_is_found_where_it_stands_once(files):
    path, text = applied(fault("self.a * self.b", "self.a + self.b"), files)
    assert path.name == "flat.py"
    assert text == files[0].text.replace("self.a * self.b", "self.a + self.b")


@pytest.mark.parametrize(("at", "name"), [("area", "flat.py"), ("volume", "solid.py"), ("solid.py", "solid.py")])
def test_a_function_or_a_file_tells_like_lines_apart(files, at, name):
    path, text = applied(fault("return a * b", "return a - b", at), files)
    assert path.name == name
    assert text.count("a - b") == 1


@pytest.mark.parametrize(
    ("line", "put", "at", "message"),
    [
        ("return a * b", "return a", "", "must stand once in the package, it stands flat.py:2, solid.py:2"),
        ("return a / b", "return a", "", "it stands nowhere"),
        ("return a * b", "return a", "Box.area", "must stand once in Box.area, it stands nowhere"),
        ("self.a * self.b", "self.a * ", "", "invalid syntax"),
        ("self.a * self.b", "self.a  *  self.b", "", "changes nothing"),
    ],
)
def test_a_fault_that_does_not_fit_says_so(files, line, put, at, message):
    with pytest.raises(FaultError, match=message.replace("(", r"\(")):
        applied(fault(line, put, at), files)
