"""``python tests/check_wheel.py WHEEL``: the wheel holds the whole package and nothing else."""

import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINKED = ("models", "losses", "train", "eval")
IGNORED_SUFFIXES = {".pyc"}


def expected_files(root: Path = ROOT) -> set[str]:
    """Files of the package as the repository has them, through the links, as names inside a wheel."""
    folders = [root / "edgeslam_torch", *(root / name for name in LINKED)]
    names = set()
    for folder in folders:
        prefix = "" if folder.name == "edgeslam_torch" else "edgeslam_torch/"
        for path in folder.rglob("*"):
            relative = path.relative_to(root)
            if path.is_file() and path.suffix not in IGNORED_SUFFIXES and "__pycache__" not in relative.parts:
                names.add(prefix + relative.as_posix())
    return names


def problems(wheel: Path, expected: set[str]) -> list[str]:
    """What is wrong with the wheel, in words; empty when nothing is."""
    with zipfile.ZipFile(wheel) as archive:
        held = archive.namelist()
    found = [f"{name} is in the wheel twice" for name in set(held) if held.count(name) > 1]
    package = {name for name in held if ".dist-info/" not in name}
    found += [f"{name} does not belong in the wheel" for name in sorted(package - expected)]
    found += [f"{name} is missing from the wheel" for name in sorted(expected - package)]
    licences = [name for name in held if name.endswith(("/LICENSE", "/NOTICE"))]
    if len(licences) != 2:
        found.append(f"LICENSE and NOTICE belong in the wheel, found {licences}")
    return found


def main() -> int:
    """Check the wheel named on the command line."""
    wheel = Path(sys.argv[1])
    found = problems(wheel, expected_files())
    for line in found:
        sys.stderr.write(f"{wheel.name}: {line}\n")
    if not found:
        sys.stdout.write(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, the package and nothing else\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
