"""``python tests/check_wheel.py DIST``: build wheel and source distribution, and check what is in them.

The wheel is built three times: here, in a copy without symbolic links (a zip download, Windows) and from the source
distribution. All three must hold the whole package, the same bytes, and nothing else.
"""

import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
LINKED = ("models", "losses", "train", "eval")
"""Folders at the root that are parts of the package."""
NOT_DISTRIBUTED = (".ci/", ".github/")


def repository_files(root: Path = ROOT) -> list[str]:
    """What git tracks or would, links included."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.split("\0")
    return sorted({name for name in listed if (root / name).is_file() or (root / name).is_symlink()})


def build(folder: Path, out: Path, kind: str) -> Path:
    """Wheel or sdist of a source folder."""
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(out)],
        cwd=folder,
        check=True,
        capture_output=True,
    )
    return next(out.glob("*.whl" if kind == "wheel" else "*.tar.gz"))


def copy_without_links(files: list[str], target: Path) -> Path:
    """The repository as git checks it out with ``core.symlinks=false``: a link is a text file with its target."""
    for name in files:
        source, copy = ROOT / name, target / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        if source.is_symlink():
            copy.write_text(str(source.readlink()))
        else:
            shutil.copyfile(source, copy)
    return target


def unpacked(sdist: Path, target: Path) -> Path:
    """The source distribution's folder."""
    with tarfile.open(sdist) as archive:
        archive.extractall(target, filter="data")
    return next(target.iterdir())


def checksums(wheel: Path) -> dict[str, int]:
    """CRC-32 of each file."""
    with zipfile.ZipFile(wheel) as archive:
        return {entry.filename: entry.CRC for entry in archive.infolist()}


def differences(what: str, held: set[str], expected: set[str]) -> list[str]:
    """Missing and surplus files, in words."""
    surplus = [f"{what}: {name} does not belong there" for name in sorted(held - expected)]
    return surplus + [f"{what}: {name} is missing" for name in sorted(expected - held)]


def problems(dist: Path) -> list[str]:
    """Build everything, the wheel and the sdist into ``dist``; what is wrong, in words.

    All in the repository belongs into the sdist, examples and tests too, but neither links nor CI.
    """
    files = repository_files()
    links = {f"edgeslam_torch/{name}" for name in LINKED}
    package = {name if name.startswith("edgeslam_torch/") else f"edgeslam_torch/{name}" for name in files
               if name.split("/")[0] in ("edgeslam_torch", *LINKED)}  # fmt: skip
    wheel, sdist = build(ROOT, dist, "wheel"), build(ROOT, dist, "sdist")
    with zipfile.ZipFile(wheel) as archive:
        held = archive.namelist()
    found = [f"wheel: {name} is there twice" for name in set(held) if held.count(name) > 1]
    found += differences("wheel", {name for name in held if ".dist-info/" not in name}, package - links)
    licences = [name for name in held if name.endswith(("/LICENSE", "/NOTICE"))]
    found += [] if len(licences) == 2 else [f"wheel: LICENSE and NOTICE belong there, found {licences}"]
    with tarfile.open(sdist) as archive:
        held = [name.split("/", 1)[1] for name in archive.getnames()]
    distributed = {name for name in files if not name.startswith(NOT_DISTRIBUTED)} - links
    found += differences("sdist", set(held), distributed | {"PKG-INFO"})
    with tempfile.TemporaryDirectory() as folder:
        for what, source in (
            ("a checkout without links", copy_without_links(files, Path(folder) / "copy")),
            ("the sdist", unpacked(sdist, Path(folder) / "sdist")),
        ):
            other, here = checksums(build(source, Path(folder) / what, "wheel")), checksums(wheel)
            found += differences(f"wheel from {what}", set(other), set(here))
            found += [f"wheel from {what}: {n} differs" for n in here.keys() & other.keys() if here[n] != other[n]]
    return found


def main() -> int:
    """Fill the folder named on the command line, and judge what is in it."""
    dist = Path(sys.argv[1]).resolve()
    found = problems(dist)
    for line in found:
        sys.stderr.write(f"{line}\n")
    for path in sorted(dist.iterdir()) if not found else []:
        sys.stdout.write(f"{path}: {path.stat().st_size / 1e6:.1f} MB, all that belongs there and nothing else\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
