import csv
import errno
import io
import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5netcdf
import numpy as np
import pytest

from rigidfleet.errors import ResultError
from rigidfleet.result import LABELS, VARIABLES, PhaseRecord, Result

MISSION = '# Grüße\nschema_version = 1\nname = "test"\n' + "# long\n" * 20_000


def a_result(
    samples: int = 41, agents: int = 4, edges: int = 5, seed: int = 0, **changes
) -> Result:
    """Random arrays of the right shapes with gaps of NaN, and a switch of phases in the middle."""
    rng = np.random.default_rng(seed)
    sizes = {"time": samples, "agent": agents, "edge": edges} | {
        d: len(n) for d, n in LABELS.items()
    }
    arrays: dict[str, Any] = {}
    for name, variable in VARIABLES.items():
        value = rng.normal(size=[sizes[d] for d in variable.dims])
        if name.startswith(("attitude", "slot", "frame")):
            value[: samples // 3] = np.nan
        arrays[name] = value
    half = samples // 2
    t = np.linspace(0, 20, samples)
    t[half] = np.nextafter(t[half - 1], math.inf)
    arrays |= {
        "time": t,
        "phase": np.arange(samples) >= half,
        "edges": np.array(
            [(i, j) for i in range(agents) for j in range(i + 1, agents)][:edges]
        ).reshape(-1, 2),
        "separation_pair": rng.integers(0, agents, (samples, 2)),
        "clearance_agent": rng.integers(0, agents, samples),
        "clearance_obstacle": np.full(samples, -1),
    }
    target = {
        "time": 20.0,
        "position": [1.0, 2.0, 0.1],
        "velocity": None,
        "attitude": None,
        "rates": None,
    }
    rest: dict[str, Any] = {
        "phases": [
            PhaseRecord("first", "establish", "open", "triangle", 0.0, t[half - 1], settled=True),
            PhaseRecord("second", "fly", "tracking", None, t[half - 1], 20.0, None, target),
        ],
        "mission_text": MISSION,
        "statistics": {"steps": 12, "wall": 0.1, "compiled": False, "events": [1, None]},
    }
    return Result(**(arrays | rest | changes))


def assert_same(a: Result, b: Result) -> None:
    for name in VARIABLES:
        x, y = getattr(a, name), getattr(b, name)
        assert x.dtype == y.dtype, name
        np.testing.assert_array_equal(x, y, err_msg=name, strict=True)
    for name in (
        "phases",
        "mission_text",
        "complete",
        "ending",
        "statistics",
        "versions",
        "platform",
        "created",
    ):
        assert getattr(a, name) == getattr(b, name), name


def leftovers(folder: Path, *known: Path) -> set[Path]:
    return set(folder.iterdir()) - set(known)


# -- save and load


@pytest.mark.parametrize(("agents", "edges"), [(4, 5), (1, 0), (2, 1), (8, 18)])
def test_a_result_survives_saving_bit_by_bit(tmp_path, agents, edges):
    """What is loaded is what was saved: every bit of every array, types, texts, also without any edge."""
    result = a_result(
        agents=agents, edges=edges, complete=False, ending="stopped at 3 s: σ₁ = 1e-9"
    )
    result.save(tmp_path / "a.nc")
    assert_same(result, Result.load(str(tmp_path / "a.nc")))
    assert not leftovers(tmp_path, tmp_path / "a.nc")


def test_a_result_of_one_sample_survives(tmp_path):
    """A flight that ends before it begins can be saved, too."""
    full = a_result()
    first = {n: getattr(full, n)[:1] for n, v in VARIABLES.items() if v.dims[0] == "time"}
    start = a_result(**first, complete=False, ending="singular at the start")
    start.save(tmp_path / "a.nc")
    assert_same(start, Result.load(tmp_path / "a.nc"))


def test_numpy_numbers_and_infinities_in_statistics_become_plain(tmp_path):
    """Statistics may hold NumPy numbers; what is not finite is read back as None."""
    statistics = {
        "steps": np.int64(3),
        "h": np.array([0.5, 1.0]),
        "limit": math.inf,
        "ok": np.True_,
    }
    a_result(statistics=statistics).save(tmp_path / "a.nc")
    expected = {"steps": 3, "h": [0.5, 1.0], "limit": None, "ok": True}
    assert Result.load(tmp_path / "a.nc").statistics == expected


def test_it_opens_in_xarray_in_one_line(tmp_path):
    """xarray sees named dimensions, labelled coordinates, units and meanings."""
    xarray = pytest.importorskip("xarray")
    result = a_result()
    result.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as ds:
        assert ds.position.dims == ("time", "agent", "axis")
        assert ds.sizes == {
            "time": 41,
            "agent": 4,
            "edge": 5,
            "axis": 3,
            "quaternion": 4,
            "wrench": 6,
            "end": 2,
            "rotor": 4,
            "link": 2,
            "message": 3,
        }
        assert list(ds.agent.values) == [1, 2, 3, 4]
        assert list(ds.edge.values) == ["1-2", "1-3", "1-4", "2-3", "2-4"]
        assert float(ds.position.sel(agent=2, axis="z")[7]) == result.position[7, 1, 2]
        assert float(ds.constraint.sel(edge="1-4")[7]) == result.constraint[7, 2]
        np.testing.assert_array_equal(ds.time, result.time)  # seconds, not decoded into dates
        assert ds.attrs["mission"] == MISSION
        for name, variable in VARIABLES.items():
            assert (ds[name].attrs["units"], ds[name].attrs["long_name"]) == variable[1:3], name


def test_an_edgeless_result_opens_in_xarray(tmp_path):
    """One agent has no edges: their dimension has length 0 and nothing else changes."""
    xarray = pytest.importorskip("xarray")
    a_result(agents=1, edges=0).save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as ds:
        assert ds.constraint.shape == (41, 0)


def test_a_rewritten_file_still_loads(tmp_path):
    """A result that xarray has read and written again is a result."""
    xarray = pytest.importorskip("xarray")
    result = a_result()
    result.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as ds:
        ds.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    assert_same(result, Result.load(tmp_path / "b.nc"))


def test_importing_results_is_light():
    """Neither h5netcdf nor anything heavier is imported before a result is read or written."""
    code = (
        "import sys, rigidfleet.result as r; "
        "heavy = {'h5netcdf', 'h5py', 'xarray', 'scipy', 'numba', 'pydantic', 'matplotlib', 'rich'}; "
        "sys.exit(str(heavy & set(sys.modules)) if heavy & set(sys.modules) else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


# -- what cannot be loaded


def refusal(path: Path) -> str:
    with pytest.raises(ResultError) as caught:
        Result.load(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    """Where there is no file, the message says so."""
    assert "no such file" in refusal(tmp_path / "a.nc")


def test_a_folder_is_no_result(tmp_path):
    """A folder is told from a file."""
    assert "is a folder" in refusal(tmp_path)


@pytest.mark.parametrize(
    "content", [b"", b"schema_version = 1\n", b"CDF\x01" + bytes(100), bytes(5000)]
)
def test_other_files_are_no_results(tmp_path, content):
    """Empty files, text, netCDF-3 and zeros are refused as what they are."""
    (tmp_path / "a.nc").write_bytes(content)
    assert ("is not a netCDF-4 file" if content else "is empty") in refusal(tmp_path / "a.nc")


def test_a_foreign_netcdf_file_is_no_result(tmp_path):
    """Somebody else's netCDF-4 file is refused as such."""
    with h5netcdf.File(tmp_path / "a.nc", "w") as file:
        file.dimensions = {"time": 3}
        file.create_variable("time", ("time",), "f8")
    assert "not a result of rigidfleet" in refusal(tmp_path / "a.nc")


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    """A file of a later format is not half understood: a newer version is asked for."""
    monkeypatch.setattr("rigidfleet.result.netcdf.SCHEMA_VERSION", 5)
    a_result().save(tmp_path / "a.nc")
    monkeypatch.undo()
    assert "Use a newer version" in refusal(tmp_path / "a.nc")


def test_an_older_format_is_refused(tmp_path, monkeypatch):
    """Words have changed since: the message names both formats, and says what to do."""
    monkeypatch.setattr("rigidfleet.result.netcdf.SCHEMA_VERSION", 3)
    a_result().save(tmp_path / "a.nc")
    monkeypatch.undo()
    told = refusal(tmp_path / "a.nc")
    assert "(result format 3); this version reads format 4" in told
    assert "Fly the mission again" in told


@pytest.mark.parametrize("kept", [0.001, 0.1, 0.5, 0.9, 0.9999])
def test_a_truncated_result_is_damaged(tmp_path, kept):
    """Wherever a file is cut off, it does not load."""
    a_result().save(tmp_path / "a.nc")
    whole = (tmp_path / "a.nc").read_bytes()
    (tmp_path / "a.nc").write_bytes(whole[: int(kept * len(whole))])
    assert "damaged" in refusal(tmp_path / "a.nc")


def test_a_flipped_bit_is_noticed(tmp_path):
    """A single bit that flips inside the numbers is damage, not another flight."""
    result = a_result()
    result.save(tmp_path / "a.nc")
    whole = bytearray((tmp_path / "a.nc").read_bytes())
    at = whole.find(result.position.tobytes())
    assert at > 0
    whole[at + 100] ^= 4
    (tmp_path / "a.nc").write_bytes(whole)
    assert "damaged" in refusal(tmp_path / "a.nc")


def test_random_damage_is_an_error_or_harmless(tmp_path):
    """Bytes overwritten anywhere give a ResultError, never another exception or other numbers."""
    result = a_result(samples=200, mission_text="")
    result.save(tmp_path / "a.nc")
    whole = (tmp_path / "a.nc").read_bytes()
    rng = np.random.default_rng(1)
    refused = 0
    for at in rng.integers(8, len(whole) - 16, 20):
        damaged = bytearray(whole)
        damaged[at : at + 16] = rng.bytes(16)
        (tmp_path / "a.nc").write_bytes(damaged)
        try:
            loaded = Result.load(tmp_path / "a.nc")
        except ResultError:
            refused += 1
            continue
        for name in VARIABLES:
            np.testing.assert_array_equal(
                getattr(loaded, name), getattr(result, name), err_msg=name
            )
    assert refused > 10


# -- what cannot be written


class Disk:
    """A file that takes some bytes and then fails."""

    def __init__(self, error: BaseException, room: int) -> None:
        self.error, self.room = error, room

    def __call__(self, path, mode, **_):
        file = io.FileIO(path, "xb")
        write = file.write

        def some(data: bytes) -> int:
            write(data[: self.room])
            raise self.error

        file.write = some  # ty: ignore[invalid-assignment]
        return file


@pytest.mark.parametrize("write", ["save", "to_csv"])
@pytest.mark.parametrize("existing", [b"old", None])
def test_a_full_disk_leaves_no_trace(tmp_path, monkeypatch, write, existing):
    """A disk that fills up halfway: a ResultError, no half file, and what was there before is untouched."""
    path = tmp_path / "a.nc"
    if existing is not None:
        path.write_bytes(existing)
    full = Disk(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), 1000)
    monkeypatch.setattr("builtins.open", full)
    with pytest.raises(ResultError, match="No space left on device"):
        getattr(a_result(), write)(path)
    monkeypatch.undo()
    assert not leftovers(tmp_path, path)
    assert (path.read_bytes() if path.exists() else None) == existing


def test_an_interrupted_save_leaves_no_trace(tmp_path, monkeypatch):
    """Ctrl-C in mid-write passes through, and no half file stays."""
    path = tmp_path / "a.nc"
    monkeypatch.setattr("builtins.open", Disk(KeyboardInterrupt(), 1000))
    with pytest.raises(KeyboardInterrupt):
        a_result().save(path)
    monkeypatch.undo()
    assert not leftovers(tmp_path)


def test_a_killed_save_leaves_the_old_file(tmp_path):
    """A process killed just before the file takes its place leaves the old file, and the part is not a .nc file."""
    path = tmp_path / "a.nc"
    path.write_bytes(b"old")
    code = (
        "import os, sys; from pathlib import Path; from rigidfleet._common import files; "
        "os.replace = lambda *a: os._exit(9); files.write_file(Path(sys.argv[1]), b'new')"
    )
    assert subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode == 9
    assert path.read_bytes() == b"old"
    (part,) = leftovers(tmp_path, path)
    assert part.suffix == ".part"
    assert part.name.startswith(".")


def test_saving_replaces_an_existing_file_and_follows_links(tmp_path):
    """Saving over an existing file replaces it; through a symbolic link, its target."""
    (tmp_path / "real.nc").write_bytes(b"old")
    (tmp_path / "link.nc").symlink_to("real.nc")
    a_result().save(tmp_path / "link.nc")
    assert (tmp_path / "link.nc").is_symlink()
    assert_same(Result.load(tmp_path / "real.nc"), Result.load(tmp_path / "link.nc"))


def test_saving_where_nothing_can_be_written_says_why(tmp_path, monkeypatch):
    """A folder, a missing folder and a forbidden place each have their own message."""
    result = a_result(samples=5)
    with pytest.raises(ResultError, match="is a folder"):
        result.save(tmp_path)
    with pytest.raises(ResultError, match="there is no folder"):
        result.save(tmp_path / "nowhere" / "a.nc")
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match="there is no folder"):
        result.save(tmp_path / "file" / "a.nc")

    def forbidden(*_, **__):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr("builtins.open", forbidden)
    with pytest.raises(ResultError, match="permission denied"):
        result.save(tmp_path / "a.nc")


# -- CSV


def test_csv_holds_setpoints_in_order(tmp_path):
    """A row for each sample and agent, units in the header, 9 digits, empty cells, one row at a switch."""
    yaw = np.full((41, 4), np.nan)
    yaw[20:] = 1.0
    result = a_result(yaw=yaw, yaw_rate=0.0 * yaw)
    result.to_csv(tmp_path / "a.csv", flown=True)
    with open(tmp_path / "a.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    axes, parts = "xyz", (("", "m"), ("v", "m_s"), ("a", "m_s2"), ("j", "m_s3"))
    columns = [f"{name}{axis}_{unit}" for name, unit in parts for axis in axes]
    assert list(rows[0]) == ["time_s", "agent", *columns, "yaw_rad", "yaw_rate_rad_s"]
    assert len(rows) == 40 * 4
    assert rows[0]["yaw_rad"] == ""
    last = rows[-3]
    assert int(last["agent"]) == 2
    assert float(last["time_s"]) == 20
    state = [float(last[c]) for c in columns[:9]]
    flown = [x[-1, 1] for x in (result.position, result.velocity, result.acceleration)]
    np.testing.assert_allclose(state, np.concatenate(flown), rtol=5e-9)
    assert float(last["yaw_rad"]) == 1.0
    # Of the two samples at the switch the later one stays.
    switch = rows[19 * 4]
    assert float(switch["x_m"]) == pytest.approx(result.position[20, 0, 0], rel=5e-9)
    assert float(switch["yaw_rad"]) == 1.0


# -- the object


def test_arrays_of_wrong_shape_are_refused_by_name():
    """A result cannot be made with arrays that disagree."""
    with pytest.raises(ValueError, match=r"cm \(time, axis\) has shape \(41, 2\)"):
        a_result(cm=np.zeros((41, 2)))
    with pytest.raises(ValueError, match=r"multiplier \(time, edge\) has shape \(41, 4\)"):
        a_result(multiplier=np.zeros((41, 4)))
    with pytest.raises(ValueError, match="strictly increasing"):
        a_result(time=np.zeros(41))
    with pytest.raises(ValueError, match="phase has indices"):
        a_result(phase=np.full(41, 2))


def test_samples_of_a_phase():
    """The samples of all phases, in order, are all samples; an unreached phase has none."""
    result = a_result()
    assert (result.samples(0), result.samples(1), result.samples(-1)) == (
        slice(0, 20),
        slice(20, 41),
        slice(20, 41),
    )
    unreached = replace(result.phases[1], name="third")
    later = a_result(phases=[*result.phases, unreached])
    assert later.samples(2) == slice(41, 41)
    with pytest.raises(IndexError):
        result.samples(2)


def test_labels_and_summary():
    """Edges are named from 1; the repr is one line that says whether the flight is complete."""
    assert a_result(agents=3, edges=2).edge_labels == ["1-2", "1-3"]
    assert (
        repr(a_result())
        == "<Result: 4 agents, 5 edges, 2 phases, 41 samples from 0 to 20 s, complete>"
    )
    assert repr(a_result(complete=False, ending="interrupted")).endswith("incomplete: interrupted>")


def test_an_unreadable_mission_is_a_result_error():
    """A mission that this version does not take is reported as such, with what is wrong in it."""
    pytest.importorskip("rigidfleet.mission")
    with pytest.raises(ResultError, match="the mission in the result cannot be read"):
        _ = a_result(mission_text="schema_version = 99").mission
