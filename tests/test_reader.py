import io
import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from sample_flights import swarm

from rigidfleet.cli import app as cli
from rigidfleet.cli import codes
from rigidfleet.errors import ResultError
from rigidfleet.mission import mission_text
from rigidfleet.result import VARIABLES, Result
from rigidfleet.result.netcdf import ATTRIBUTES

Change = Callable[[Any], None]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of a flight of nine vehicles."""
    path = tmp_path_factory.mktemp("flight") / "a.nc"
    swarm(9, 2.0).save(path)
    return path.read_bytes()


def spoiled(whole: bytes, folder: Path, change: Change) -> Path:
    """A file that has been changed."""
    buffer = io.BytesIO(whole)
    with h5py.File(buffer, "r+") as file:
        change(file)
    (folder / "a.nc").write_bytes(buffer.getvalue())
    return folder / "a.nc"


def attribute(name: str, value: Any) -> Change:
    def change(file: Any) -> None:
        del file.attrs[name]
        file.attrs[name] = value

    return change


def phase(**entries: Any) -> Change:
    """The first phase with other entries."""

    def change(file: Any) -> None:
        phases = json.loads(file.attrs["phases"])
        phases[0] |= entries
        attribute("phases", json.dumps(phases))(file)

    return change


def array(name: str, make: Callable[[Any], Any]) -> Change:
    """An array in place of another."""

    def change(file: Any) -> None:
        value = make(file[name][...])
        del file[name]
        file[name] = value

    return change


def entry(name: str, at: Any, value: Any) -> Change:
    """One number of an array."""

    def make(old: Any) -> Any:
        old[at] = value
        return old

    return array(name, make)


def linked(file: Any) -> None:
    del file["thrust"]
    file["thrust"] = h5py.ExternalLink("/etc/hostname", "/thrust")


def outside(file: Any) -> None:
    shape = file["thrust"].shape
    del file["thrust"]
    file.create_dataset("thrust", shape, "f8", external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])


def virtual(file: Any) -> None:
    shape = file["thrust"].shape
    del file["thrust"]
    layout = h5py.VirtualLayout(shape, "f8")
    layout[...] = h5py.VirtualSource("other.h5", "thrust", shape)
    file.create_virtual_dataset("thrust", layout)


def declared(*shape: int) -> Change:
    def change(file: Any) -> None:
        del file["position"]
        file.create_dataset("position", shape, "f8", chunks=(1, *shape[1:]))

    return change


@pytest.mark.parametrize("name", [n.replace("mission_text", "mission") for n in ATTRIBUTES])
@pytest.mark.parametrize(
    "value",
    [0.5, np.arange(5), np.bytes_(b"\xff\xfe"), np.zeros((2, 2)), b"\xed\xb2\x80", np.complex128(1j),
     np.array(["a", "b"], dtype=object), h5py.Empty("f8")],
    ids=["number", "array", "bytes", "matrix", "surrogate", "complex", "texts", "empty"],
)  # fmt: skip
def test_an_attribute_of_another_type_is_damage(tmp_path, whole, name, value):
    """Numbers, arrays, bytes and half characters where text, a whole number or JSON is due are named damage."""
    path = spoiled(whole, tmp_path, attribute(name, value))
    with pytest.raises(ResultError, match=f"damaged .*attribute {name}"):
        Result.load(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (attribute("rigidfleet_schema_version", "1"), "not a whole number"),
        (attribute("statistics", "[]"), "attribute statistics"),
        (attribute("statistics", '{"steps": "many"}'), "statistics.steps"),
        (attribute("statistics", '{"rtol": NaN}'), "statistics.rtol"),
        (attribute("statistics", '{"solvers": [1]}'), "statistics.solvers"),
        (attribute("versions", '{"numpy": 2}'), "versions.numpy"),
        (attribute("versions", '"1"'), "attribute versions"),
        (attribute("phases", "[" * 100_000), "not valid JSON"),
        (attribute("phases", "[1]"), r"phases\[1\]"),
        (attribute("phases", '["\\ud800"]'), r"phases\[1\]"),
        (phase(name=1), r"phases\[1\].name"),
        (phase(name="\ud800"), r"phases\[1\].name"),
        (phase(t_start="0"), r"phases\[1\].t_start"),
        (phase(t_end=float("inf")), r"phases\[1\].t_end"),
        (phase(settled=1), r"phases\[1\].settled"),
        (phase(target={"position": [0.0, 0.0, 0.0]}), r"phases\[1\].target"),
        (phase(target={"time": 1.0, "position": [0.0, 0.0]}), r"phases\[1\].target.position"),
        (phase(more=1), r"phases\[1\]"),
        (array("position", lambda x: x.astype("c16")), "position has numbers of type complex128"),
        (array("position", lambda x: x.astype("S8")), "position has numbers of type"),
        (array("phase", lambda x: x.astype("f8")), "phase has numbers of type float64"),
        (array("time", lambda x: x.astype("i8")), "time has numbers of type int64"),
        (array("position", lambda x: x[..., None]), "position has shape"),
        (array("position", lambda x: x[:, :, :2]), r"position has shape .*, not \(time 42, agent 9, axis 3\)"),
        (array("velocity", lambda x: x[:-1]), "velocity has shape"),
        (array("time", lambda x: x[:0]), "phase has shape"),
        (array("edges", lambda x: x.reshape(-1)), "edges has shape"),
        (array("thrust", lambda x: np.float64(1.0)), "thrust has shape"),
        (lambda file: file.__delitem__("cm"), "cm is missing"),
        (entry("time", 3, np.nan), "time must be finite"),
        (entry("phase", -1, 7), "phase has indices outside"),
        (array("phase", lambda x: x[::-1].copy()), "phase must not decrease"),
        (entry("edges", (0, 0), 9), "edges has agents outside"),
        (entry("edges", (0, 0), -1), "edges has agents outside"),
        (array("edges", lambda x: 0 * x), "joins an agent to itself"),
        (entry("separation_pair", (0, 1), 2**30), "separation_pair has agents outside"),
        (entry("clearance_agent", 2, -2), "clearance_agent has agents outside"),
        (entry("attitude", 2, 0.0), "quaternion of norm zero"),
        (declared(42, 12_000_000, 3), "larger than a file of"),
        (declared(2**31, 2**31, 3), "position has shape|larger than a file of"),
        (linked, "thrust is a link, not an array"),
        (outside, "thrust is stored in another file"),
        (virtual, "thrust is stored in another file"),
    ],
)  # fmt: skip
def test_what_is_not_as_declared_is_damage(tmp_path, whole, change, words):
    """Each fault of a file is named as damage before anything is made of it, in seconds and without its memory."""
    path = spoiled(whole, tmp_path, change)
    begun = time.process_time()
    with pytest.raises(ResultError, match=f"damaged \\(.*({words})"):
        Result.load(path)
    assert time.process_time() - begun < 10.0


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (lambda text: mission_text("cube-passage"), "the mission has 8 agents, the arrays have 9"),
        (
            lambda text: re.sub(r"edges = \[\s*\[1, 2\],", "edges = [", text),
            "edges of its formations differ",
        ),
        (lambda text: text.replace("sheet", "shoot"), "no formation 'sheet'"),
    ],
)
def test_a_result_holds_its_own_mission(tmp_path, whole, capsys, text, words):
    """Of a mission with other agents, edges or formations than the arrays `report` and `replay` say so, and stop."""

    def change(file: Any) -> None:
        attribute("mission", text(file.attrs["mission"]))(file)

    path = spoiled(whole, tmp_path, change)
    for command in ("report", "replay"):
        assert cli.main([command, str(path)]) == codes.BAD_INPUT
        told = capsys.readouterr().err
        assert words in told
        assert told.count("error:") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["a.nc"]


def test_a_phase_of_no_kind_is_refused(tmp_path, whole, capsys):
    """A record names its kinds of phases; one that no mission has is no record of a flight."""
    path = spoiled(whole, tmp_path, phase(kind="loop"))
    assert cli.main(["report", str(path)]) == codes.BAD_INPUT
    assert "there is no kind of phase 'loop'" in capsys.readouterr().err


def test_what_other_tools_write_is_read(tmp_path, whole):
    """Texts as bytes or as arrays of one, compression, other byte orders and unknown attributes change nothing."""

    def change(file: Any) -> None:
        for name in ("ending", "phases", "mission"):
            attribute(name, np.bytes_(file.attrs[name].encode()))(file)
        attribute("created", np.array([file.attrs["created"]], dtype=object))(file)
        attribute("complete", np.array([1], dtype="i2"))(file)
        file.attrs["history"] = "ncks"
        for name in ("position", "phase"):
            value = file[name][...]
            del file[name]
            kind = value.dtype.newbyteorder(">")
            file.create_dataset(name, data=value.astype(kind), compression="gzip", shuffle=True)

    found, given = Result.load(spoiled(whole, tmp_path, change)), swarm(9, 2.0)
    for name in VARIABLES:
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))
    assert found.phases == given.phases
    assert found.mission_text == given.mission_text
