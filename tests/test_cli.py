import io
import json
import os
import pty
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from rigidfleet.cli import app as cli
from rigidfleet.cli import codes, console
from rigidfleet.errors import FlightError
from rigidfleet.formation.graphs import neighbour_edges
from rigidfleet.formation.shapes import SHAPES
from rigidfleet.formation.shapes import slots as slots_of
from rigidfleet.mission import mission_names, mission_text
from rigidfleet.mission.text import FIRST, GROUPS
from rigidfleet.plotting import figure_names
from rigidfleet.result import Result
from rigidfleet.rigidity import jacobian, spectrum
from rigidfleet.rigidity.design import design
from rigidfleet.simulation.flight import Progress

TRIANGLE = """
schema_version = 1
name = "short"
title = "Hold a triangle for a second"
[agents]
mass = 1.0
position = [[0, 0, 0], [4, 0, 0], [2, 3.4641016151377544, 0]]
[formations.triangle]
shape = "triangle"
size = 4.0
[[phases]]
kind = "establish"
formation = "triangle"
blend = 0.5
until = 1.0
"""
#: It flies for minutes: the controller's stiffness keeps the steps short, however still all stand.
LONG = (
    TRIANGLE.replace('"short"', '"long"').replace("[agents]", "output_step = 1e5\n[agents]")
    + '[[phases]]\nkind = "hold"\nname = "stand still"\nuntil = 1e8\n'
)
#: These do not pass: one is to settle within less than the integrator's error, the other not to move.
OFF = TRIANGLE.replace("[[0, 0, 0]", "[[0, 1, 0]")
RESTLESS = OFF.replace("until = 1.0", "settle = {tolerance = 1e-15, timeout = 2}")
SPEEDING = OFF + "[limits]\nspeed = 0.001\n"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """An empty folder to stand in, with the mission `short.toml`."""
    monkeypatch.chdir(tmp_path)
    for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    console.console.cache_clear()
    Path("short.toml").write_text(TRIANGLE, encoding="utf-8")
    yield tmp_path
    console.console.cache_clear()


@pytest.fixture
def simulate(monkeypatch):
    """Replace the simulation by another function."""

    def replace(function):
        monkeypatch.setattr(sys.modules["rigidfleet.simulation.flight"], "simulate", function)

    return replace


def write(name, text):
    Path(name).write_text(text, encoding="utf-8")
    return name


def command(*arguments, stdout=subprocess.PIPE, preexec_fn=None, **environment):
    """The command as a process of its own; its output goes to pipes."""
    done = subprocess.run(
        [sys.executable, "-m", "rigidfleet", *arguments],
        stdout=stdout,
        stderr=subprocess.PIPE,
        env=os.environ | environment,
        text=True,
        check=False,
        timeout=300,
        preexec_fn=preexec_fn,
    )
    assert "Traceback" not in done.stderr
    return done


# -- usage -------------------------------------------------------------------------------------------


def test_help_is_light():
    """Help, which gives the exit codes, loads none of the packages that take long to load."""
    heavy = {"numpy", "scipy", "numba", "pydantic", "matplotlib", "h5py", "h5netcdf", "xarray"}
    code = f"""if True:
        import sys
        from rigidfleet.cli.app import main
        for tokens in [], ["--help"], ["run", "--help"], ["--version"], ["fly"]:
            main(tokens)
        sys.exit(", ".join(sorted({heavy!r} & set(sys.modules))) or None)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for words in (
        "0 success",
        "1 the flight failed",
        "2 invalid input",
        "130 interrupted",
        "--no-figures",
    ):
        assert words in " ".join(done.stdout.split())


def test_completion(tmp_path):
    """What is installed for bash completes verbs, options and shipped missions, in a home that has nothing yet."""
    if (bash := shutil.which("bash")) is None:
        pytest.skip("no bash here")
    home = {"HOME": str(tmp_path), "PATH": os.environ["PATH"]}
    done = command("--install-completion", "--shell", "bash", **home)
    assert done.returncode == 0, done.stderr
    script = r"""
    source ~/.bashrc
    call=$(complete -p rigidfleet | sed 's/.*-F \([^ ]*\).*/\1/')
    COMP_WORDS=(rigidfleet ""); COMP_CWORD=1; $call; echo "${COMPREPLY[@]}"
    COMP_WORDS=(rigidfleet sweep --w); COMP_CWORD=2; $call; echo "${COMPREPLY[@]}"
    """
    table = Path(__file__).parents[1].joinpath("README.md").read_text("utf-8")
    flown = [*re.findall(r"^\| `rigidfleet (\w+) MISSION", table, re.MULTILINE)]
    assert {"run", "check", "sweep", "live", "tune"} <= {*flown}
    before = [*flown, "missions --print", "assess --mission"]
    for words in before:
        script += (
            f'COMP_WORDS=(rigidfleet {words} ""); COMP_CWORD={1 + len(words.split())}; $call\n'
        )
        script += 'echo "${COMPREPLY[@]}"\n'
    done = subprocess.run(
        [bash, "-c", script], env=home, capture_output=True, text=True, check=False
    )
    verbs, options, *names = done.stdout.splitlines()
    assert {*re.findall(r"^\| `rigidfleet (\w+)", table, re.MULTILINE)} <= {*verbs.split()}
    assert options.split() == ["--workers"]
    assert {x: y.split() for x, y in zip(before, names, strict=True)} == dict.fromkeys(
        before, mission_names()
    )


def test_a_home_that_cannot_be_written(tmp_path):
    """A picture is drawn without a word about the home, where nothing can be written."""
    (tmp_path / "file").touch()
    usual = dict.fromkeys(("MPLCONFIGDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME"), "")
    drawn = ("--figure", str(tmp_path / "graph.svg"))
    done = command("check", "two-agents", *drawn, **usual, HOME=str(tmp_path / "file" / "home"))
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "graph.svg").exists()


@pytest.mark.parametrize("verb", [name for name in cli.app if not name.startswith("-")])
def test_help_breaks_no_line_that_fits(verb, monkeypatch, capsys):
    """On a wide terminal each paragraph of the help, and of each option, stands in one line."""
    monkeypatch.setenv("COLUMNS", "2000")
    assert cli.main([verb, "--help"]) == 0
    text = capsys.readouterr().out
    assert "─ Parameters ─" in text
    assert not re.findall(r"(?m)^│ {7,}\S.*", text)  # below the text of an option
    assert not re.findall(r"(?m)^\w.*\n\w.*", text)


def test_module_is_the_command():
    """`python -m rigidfleet` is the command."""
    done = command("--version")
    assert (done.returncode, done.stdout) == (0, "rigidfleet 0.1.0\n")


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["rnu"], 'Did you mean "run"'),
        (["run", "short.toml", "--ouut", "x"], "Did you mean --out"),
        (["run"], "MISSION requires an argument"),
        (["run", "short.toml", "more"], "Unexpected arguments: more"),
        (["missions", "--print"], "--print requires an argument"),
        (["missions", "--print", "square", "--schema"], "cannot be combined"),
        (["missions", "--print", "sqare"], "did you mean 'square'"),
        (["run", "sqare"], "did you mean 'square'"),
        (["check", "nowhere.toml"], "no such file"),
        (["report", "nowhere.nc"], "no such file"),
        (["report", "short.toml"], "not a netCDF-4 file"),
    ],
)
def test_bad_input(capsys, tokens, words):
    """Bad input exits with 2 and says on standard error, and there alone, what to do."""
    assert cli.main(tokens) == codes.BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert words in " ".join(err.split())


# -- missions, check ---------------------------------------------------------------------------------


def test_missions(capsys, monkeypatch):
    """Each shipped mission has one line below its group, with its table or figure of the paper."""
    monkeypatch.setenv("COLUMNS", "200")
    assert cli.main(["missions"]) == codes.PASSED
    head, *lines, empty, first = capsys.readouterr().out.splitlines()
    assert "in the paper" in head
    groups = [line.strip() for line in lines if not line.startswith("  ")]
    assert groups == [*GROUPS]
    lines = [line.strip() for line in lines if line.startswith("  ")]
    assert [line.split()[0] for line in lines] == [
        name for names in GROUPS.values() for name in names
    ]
    assert empty == ""
    assert all(name in first for name in FIRST)
    passage = next(line for line in lines if line.startswith("narrow-passage"))
    assert "unfold" in passage
    assert "Table 3" in passage


def test_missions_print(capfdbinary):
    """A mission is printed as it is shipped, byte for byte."""
    assert cli.main(["missions", "--print", "narrow-passage"]) == codes.PASSED
    assert capfdbinary.readouterr().out == mission_text("narrow-passage").encode()


def test_missions_schema(capsys):
    """The schema is JSON and describes the mission's keys."""
    assert cli.main(["missions", "--schema"]) == codes.PASSED
    assert "phases" in json.loads(capsys.readouterr().out)["properties"]


@pytest.mark.parametrize("verb", ["check", "run"])
def test_a_trajectory_is_no_mission(verb, tmp_path, capsys):
    """Who checks or flies a trajectory is told which verb judges it."""
    path = tmp_path / "way.csv"
    path.write_text("time,x,y,z\n0,0,0,1\n1,1,0,1\n")
    assert cli.main([verb, str(path)]) == codes.BAD_INPUT
    assert "trajectories are judged by `rigidfleet assess`" in capsys.readouterr().err


def test_check(capsys, monkeypatch):
    """A mission that is right is counted up, and its phases are listed; in a pipe no line is longer than 80."""
    assert cli.main(["check", "narrow-passage"]) == codes.PASSED
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("guide" in line for line in lines)
    console.console.cache_clear()
    monkeypatch.setenv("COLUMNS", "100")
    assert cli.main(["check", "narrow-passage"]) == codes.PASSED
    first, _, *lines = capsys.readouterr().out.splitlines()
    assert first == "narrow-passage: valid: 3 agents, 2 formations, 12 phases, 90 s"
    phases, facts = lines[: lines.index("")], lines[lines.index("") :]
    assert len(phases) == 12
    assert facts[-1] == "narrow-passage: no problems found"
    assert "infinitesimally rigid" in facts[2]
    wp2 = "WP2 fly (35, 7.5, 20) m, (2, 0, 0) m/s, yaw 0° at 32 s tracking"
    assert " ".join(phases[3].split()) == f"4 {wp2}"


def test_check_words(capsys, monkeypatch):
    """Ends by settling or duration are told apart, and turned angles are named."""
    monkeypatch.setenv("COLUMNS", "100")
    text = (
        RESTLESS
        + '[[phases]]\nkind = "turn"\nroll_deg = 5\nrates_deg_s = [0, 0, 1]\nduration = 4\n'
    )
    assert cli.main(["check", write("restless.toml", text)]) == codes.PASSED
    first, _, *phases = capsys.readouterr().out.splitlines()
    assert first.endswith("1 formation, 2 phases, at most 6 s")
    assert "settled, within 2 s" in phases[0]
    assert "roll 5°, yaw 0°, (0, 0, 1) °/s" in phases[1]
    assert "after 4 s" in phases[1]


def test_check_json(capsys):
    """As JSON, a mission that is right is described in plain data."""
    assert cli.main(["check", "narrow-passage", "--json"]) == codes.PASSED
    found = json.loads(capsys.readouterr().out)
    assert found["right"] is True
    assert (found["agents"], found["latest_end_s"], len(found["phases"])) == (3, 90.0, 12)
    assert found["passed"] is True
    assert found["formations"]["line"]["rigidity"]["rigidity_class"] == "prestress-stable"


def test_check_that_fails(capsys):
    """What will fail is said, with exit code 1; in JSON, too."""
    assert cli.main(["check", "establish-cube-as-printed"]) == codes.FAILED
    assert "fails  'cube' will have another shape" in capsys.readouterr().out
    assert cli.main(["check", "establish-cube-as-printed", "--json"]) == codes.FAILED
    assert json.loads(capsys.readouterr().out)["passed"] is False


def test_check_realisations(capsys):
    """The search for other shapes is made unless it is forbidden."""
    assert cli.main(["check", "establish-cube"]) == codes.PASSED
    assert "random starts" in capsys.readouterr().out
    assert cli.main(["check", "establish-cube", "--no-realisations"]) == codes.PASSED
    assert "random starts" not in capsys.readouterr().out


def test_check_figure(capsys):
    """The graphs are drawn to the file asked for; one of another kind is refused."""
    assert cli.main(["check", "square", "--figure", "graph.svg"]) == codes.PASSED
    assert "flex-1-" in Path("graph.svg").read_text(encoding="utf-8")
    assert cli.main(["check", "square", "--figure", "graph.gif"]) == codes.BAD_INPUT
    assert "graph.gif: the name has no figure format" in capsys.readouterr().err


WRONG = TRIANGLE.replace("mass = 1.0", "mass = -1").replace("size = 4.0", "size = nan\ncolour = 3")


def test_check_wrong(capsys):
    """All errors of a mission are told at once, each with key, value and remedy."""
    assert cli.main(["check", write("wrong.toml", WRONG)]) == codes.BAD_INPUT
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("error: wrong.toml: ") == 3
    assert "agents.mass = -1" in err


def test_check_wrong_json(capsys):
    """As JSON, the errors are on standard output, and the exit code is the same."""
    assert cli.main(["check", write("wrong.toml", WRONG), "--json"]) == codes.BAD_INPUT
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert err == ""
    assert found["right"] is False
    assert {finding["key"] for finding in found["findings"]} >= {"agents.mass"}
    assert all(finding["remedy"] for finding in found["findings"])


# -- new ---------------------------------------------------------------------------------------------


def test_new(capsys):
    """A new mission is written where it says, is right, and is kept unless it is to be replaced."""
    assert cli.main(["new", "mine", "--shape", "square", "--to", "3", "-4", "9"]) == codes.PASSED
    assert "mine.toml: 4 agents, 1 formation, 4 phases" in capsys.readouterr().out
    assert cli.main(["check", "mine.toml"]) == codes.PASSED
    assert "(3, -4, 9) m" in capsys.readouterr().out
    text = Path("mine.toml").read_text(encoding="utf-8")
    assert cli.main(["new", "mine"]) == codes.BAD_INPUT
    assert "mine.toml: already exists" in capsys.readouterr().err
    assert Path("mine.toml").read_text(encoding="utf-8") == text
    assert cli.main(["new", "mine.toml", "--force", "--quiet"]) == codes.PASSED
    assert capsys.readouterr() == ("", "")
    assert 'shape = "triangle"' in Path("mine.toml").read_text(encoding="utf-8")


def test_new_without_a_terminal_asks_nothing():
    """Where nobody can answer, a new mission is that of the defaults."""
    done = command("new")
    assert done.returncode == codes.PASSED
    assert done.stdout.startswith("mission.toml: 3 agents")
    assert done.stderr == ""


def test_new_names_every_shape(capsys):
    """Help names the shapes that there are."""
    cli.main(["new", "--help"])
    words = re.split(r"\W+", capsys.readouterr().out)
    assert SHAPES.keys() <= {*words}


def test_new_json(capsys):
    """As JSON, a new mission is described as `check` describes it."""
    assert cli.main(["new", "mine", "--json", "--agents", "6"]) == codes.PASSED
    found = json.loads(capsys.readouterr().out)
    assert (found["file"], found["agents"], found["formations"]) == ("mine.toml", 6, ["hexagon"])


@pytest.mark.parametrize(
    ("tokens", "words"),
    [
        (["--shape", "trangle"], "did you mean 'triangle'"),
        (["--shape", "pentagon"], "did you mean 'polygon' with 5 agents?"),
        (["--agents", "2.5"], "Invalid value for --agents: '2.5' is not a whole number."),
        (["--agents", "1e400"], "is not a whole number"),
        (["--thrust-limit", "5"], "the flight would fail: agent 1 would need"),
        (["--shape", "sphere", "--agents", "300", "--to", "9", "9", "9"], "reaches 22.6 m below"),
        (["--mass", "-1"], "agents.mass = -1"),
        (["--to", "1", "2"], "requires"),
    ],
)
def test_new_that_cannot_be(capsys, tokens, words):
    """A mission that would be wrong is not written."""
    assert cli.main(["new", "mine", *tokens]) == codes.BAD_INPUT
    assert words in " ".join(capsys.readouterr().err.split())
    assert not Path("mine.toml").exists()


@pytest.mark.parametrize(
    "tokens",
    [
        ["sweep", "two-agents", "--vary", "gravity=9,10", "--runs", "2.5"],
        ["sweep", "two-agents", "--vary", "gravity=9,10", "--seed", "1.5"],
        ["sweep", "two-agents", "--vary", "gravity=9,10", "--workers", "1.5"],
        ["design", "sphere", "--agents", "12.5"],
        ["live", "two-agents", "--port", "80.5"],
    ],
)
def test_a_whole_number_is_not_rounded(capsys, tokens):
    """Wherever a count is asked for, a fraction is one clear error."""
    assert cli.main(tokens) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert f"'{tokens[-1]}' is not a whole number." in err
    assert err.count("error") == 1


def test_new_into_no_folder(capsys):
    """A folder that is not there is an error that says so."""
    assert cli.main(["new", "no/folder/mine", "--quiet"]) == codes.BAD_INPUT
    assert "there is no folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["/", "."])
def test_new_where_a_folder_is(capsys, name):
    """It is bad input, and no fault of the program."""
    assert cli.main(["new", name, "--quiet"]) == codes.BAD_INPUT
    assert f"{name}: is a folder" in capsys.readouterr().err


def test_new_asks_on_a_terminal(folder):
    """On a terminal a few questions are asked; an answer that cannot be is asked for again."""
    answers = ["asked", "polgon", "polygon", "2", "7", "", "x", "2", "1 2", "10, 5 9"]
    out = on_terminal(["new"], answers)
    for words in (
        "did you mean 'polygon'",
        "3 or more agents, not 2",
        "'x' is not a number",
        "Enter three",
    ):
        assert words in out
    text = Path("asked.toml").read_text(encoding="utf-8")
    for line in ('shape = "polygon"', "mass = 2 ", "size = 4 ", "position = [10, 5, 9]"):
        assert line in text
    assert "No answer" in on_terminal(["new"], [None])
    assert not Path("mission.toml").exists()


def on_terminal(arguments: list[str], answers: Sequence[str | None]) -> str:
    """What a terminal shows of the command, each answer given when it is asked for; None ends the input."""
    terminal, side = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "rigidfleet", *arguments],
        stdin=side, stdout=side, stderr=side,
        env=os.environ | {"COLUMNS": "200", "TERM": "xterm"},
    ) as process:  # fmt: skip
        os.close(side)
        shown, since = "", 0
        for answer in answers:
            while "]: " not in shown[since:]:
                shown += os.read(terminal, 4096).decode()
            since = len(shown)
            os.write(terminal, b"\x04" if answer is None else answer.encode() + b"\n")
        try:
            while more := os.read(terminal, 4096):
                shown += more.decode()
        except OSError:  # the terminal's other end is closed
            pass
        os.close(terminal)
        process.wait(timeout=60)
    return shown


# -- design ------------------------------------------------------------------------------------------


CUBE = slots_of("cube", 4.0, 8)


def test_design(capsys):
    """The designed cube beats the paper's 18 edges, and its formation can be flown as printed."""
    assert cli.main(["design", "cube"]) == codes.PASSED
    out, err = capsys.readouterr()
    rows = {line[:14].strip(): line.split() for line in err.splitlines()[1:]}
    w, w_max = (
        np.linalg.svd(jacobian(CUBE, design(CUBE)), compute_uv=False)[q] ** 2 for q in (-1, 0)
    )
    assert rows["designed"][5:7] == ["0.6180", f"{w_max / w:.3g}"]
    assert rows["the paper's 18"][7] == "0.5085"
    assert rows["all pairs"][2] == "28"
    mission = mission_text("establish-cube").split("[formations.cube]")[0]
    phase = '[[phases]]\nkind = "establish"\nformation = "cube"\nuntil = 9\n'
    assert cli.main(["check", write("mine.toml", mission + out + phase)]) == codes.PASSED


def test_design_of_points(capsys):
    """Points from a file get their edges; what distances do not hold of a flat shape is said."""
    Path("flat.csv").write_text("x,y,z\n0,0,0\n4,0,0\n4,4,0\n0,4,0\n", encoding="utf-8")
    assert cli.main(["design", "flat.csv", "--extra", "complete", "--json"]) == codes.PASSED
    found = json.loads(capsys.readouterr().out)
    assert found["graphs"]["designed"]["edges"] == 6
    assert "The shape is flat" in found["limits"]
    assert found["toml"].startswith("[formations.flat]")


def test_design_by_a_named_graph(capsys):
    """A graph for many agents is taken by name, judged by its index, and stays a name in the formation."""
    command = ["design", "shells", "--agents", "300", "--size", "2", "--edges"]
    assert cli.main([*command, "neighbours", "--reach", "1.8", "--json"]) == codes.PASSED
    found = json.loads(capsys.readouterr().out)
    graph = found["graphs"]["neighbours"]
    slots = slots_of("shells", 2.0, 300)
    ends = spectrum(slots, neighbour_edges(slots, 1.8), np.ones(300))
    assert graph["index"] == pytest.approx(ends.index)
    assert graph["condition"] == pytest.approx(ends.condition)
    form = tomllib.loads(found["toml"])["formations"]["shells"]
    assert (form["edges"], form["reach"]) == ("neighbours", 1.8)
    assert cli.main([*command, "henneberg-multilevel"]) == codes.PASSED
    out, err = capsys.readouterr()
    assert 'edges = "henneberg-multilevel"' in out
    words = " ".join(err.split())
    assert "henneberg-multilevel 894 full" in words
    assert "infinitesimally rigid" in words


def test_design_keeps_files(capsys):
    """A file that is there is kept, unless it is to be replaced."""
    arguments = ["design", "square", "--out", "square.toml"]
    assert cli.main(arguments) == codes.PASSED
    assert "Formation  square.toml" in capsys.readouterr().out
    assert cli.main(arguments) == codes.BAD_INPUT
    assert cli.main([*arguments, "--force", "--extra", "1"]) == codes.PASSED
    assert len(tomllib.loads(Path("square.toml").read_text())["formations"]["square"]["edges"]) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["cube", "--range", "3"], "5.65685 m is enough"),
        (["cube", "--extra", "some"], "cube: --extra: 'some' is not a number"),
        (["cub"], "cub: is neither a shape nor a file: did you mean 'cube'?\n"),
        (["cube", "--extra", "-1"], "extra must be >= 0"),
        (["cube", "--extra", "inf"], "'inf' is not a whole number"),
        (["cube", "--extra", "1.5"], "'1.5' is not a whole number"),
        (["cube", "--reach", "2"], "--reach has no effect without --edges neighbours"),
        (["cube", "--range", "nan"], "--range must be a positive length"),
        (["cube", "--edges", "neighbours", "--reach", "0"], "--reach must be a positive number"),
        (["sphere"], "give --agents"),
        (["cube", "--edges", "all"], "there is no graph 'all'"),
        (["cube", "--edges", "henneberg-multilevel", "--reach", "2"], "--reach has no effect"),
        (
            ["cube", "--edges", "henneberg-multilevel", "--extra", "2"],
            "--extra and --range have no effect with --edges",
        ),
        (["square", "--edges", "henneberg"], "need slots"),
        (["cube", "--agents", "7"], "takes 8 agents"),
        (["blob"], "neither a shape nor a file"),
        (["short.toml", "--size", "4"], "use --spacing"),
        (["short.toml"], "short.toml"),
    ],
)
def test_design_of_nothing(arguments, message, capsys):
    """What cannot be designed is refused with a reason."""
    assert cli.main(["design", *arguments]) == codes.BAD_INPUT
    assert message in capsys.readouterr().err


# -- run ---------------------------------------------------------------------------------------------


def test_run(capsys, folder):
    """A flight leaves its result and verdict in flights/NAME, and says so."""
    assert cli.main(["run", "short.toml", "--no-figures", "--csv"]) == codes.PASSED
    out = capsys.readouterr().out
    home = folder / "flights" / "short"
    assert sorted(p.name for p in home.iterdir()) == ["short.csv", "short.nc", "verdict.json"]
    assert "Passed" in out
    for name in ("short.nc", "short.csv", "verdict.json"):
        assert os.path.join("flights", "short", name) in out
    assert Result.load(home / "short.nc").complete
    assert json.loads((home / "verdict.json").read_text(encoding="utf-8"))["passed"] is True


def test_run_json(capsys):
    """With --json, standard output is the verdict's file and nothing else."""
    assert cli.main(["run", "short.toml", "--no-figures", "--json", "--out", "x"]) == codes.PASSED
    assert capsys.readouterr().out == Path("x/verdict.json").read_text(encoding="utf-8")


def test_run_quiet(capsys):
    """With --quiet, a flight that passes prints nothing at all."""
    assert cli.main(["run", "short.toml", "--no-figures", "--quiet"]) == codes.PASSED
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("text", "complete", "words"),
    [(SPEEDING, True, "speed"), (RESTLESS, False, "did not settle")],
    ids=["limit passed", "incomplete"],
)
def test_run_fails_its_verdict(capsys, text, complete, words):
    """A flight that passes a limit, or cannot be flown to its end, exits with 1 and is saved."""
    assert cli.main(["run", write("bad.toml", text), "--no-figures"]) == codes.FAILED
    out = capsys.readouterr().out
    assert "Failed" in out
    assert words in " ".join(out.split())
    assert Result.load("flights/short/short.nc").complete is complete


def test_run_keeps_an_existing_result(capsys, simulate):
    """An existing result is kept, and nothing is flown, unless it is to be replaced."""
    assert cli.main(["run", "short.toml", "--no-figures", "--quiet"]) == codes.PASSED
    before = Path("flights/short/short.nc").read_bytes()
    simulate(lambda *_, **__: pytest.fail("it flew"))
    assert cli.main(["run", "short.toml"]) == codes.BAD_INPUT
    err = capsys.readouterr().err
    assert "short.nc: already exists" in err
    assert "--force" in err
    assert Path("flights/short/short.nc").read_bytes() == before


def test_run_keeps_the_verdict_of_another_flight(capsys):
    """A verdict.json of another mission in the same folder is not overwritten."""
    Path("shared").mkdir()
    write("shared/verdict.json", "theirs")
    assert cli.main(["run", "short.toml", "--out", "shared"]) == codes.BAD_INPUT
    assert "verdict.json: already exists" in capsys.readouterr().err
    assert Path("shared/verdict.json").read_text(encoding="utf-8") == "theirs"


def test_run_force():
    """With --force nothing of an earlier flight stays beside the new result, and all else does."""
    home = Path("flights/short")
    (home / "figures").mkdir(parents=True)
    for name in ("short.nc", "short.csv", "verdict.json", "figures/cm.png"):
        write(home / name, "earlier")
    for name in ("notes.txt", "figures/mine.png"):
        write(home / name, "mine")
    assert cli.main(["run", "short.toml", "--no-figures", "--force", "--quiet"]) == codes.PASSED
    assert Result.load(home / "short.nc").complete
    found = {str(p.relative_to(home)) for p in home.rglob("*") if p.is_file()}
    assert found == {"short.nc", "verdict.json", "notes.txt", os.path.join("figures", "mine.png")}


@pytest.mark.parametrize("out", ["short.toml", "short.toml/deep/down"])
def test_run_into_no_folder(capsys, simulate, out):
    """A folder that cannot be written is an error before anything is flown, and leaves nothing."""
    simulate(lambda *_, **__: pytest.fail("it flew"))
    assert cli.main(["run", "short.toml", "--out", out]) == codes.BAD_INPUT
    assert "--out" in capsys.readouterr().err
    assert [p.name for p in Path().iterdir()] == ["short.toml"]


def test_run_on_a_full_disk():
    """A disk that is full at the end of a flight is one clear error, and leaves no half of a file."""

    def shrink():
        resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))

    command("run", "short.toml", "--no-figures", "--out", "before")  # leaves what is compiled
    done = command("run", "short.toml", "--no-figures", preexec_fn=shrink)
    assert done.returncode == codes.BAD_INPUT
    assert done.stderr.splitlines()[-1].startswith(
        "error: flights/short/short.nc: cannot be written"
    )
    assert list(Path("flights/short").iterdir()) == []


def test_errors_of_a_flight(capsys, simulate):
    """A flight that cannot begin is an error to read, not a traceback."""

    def refuse(*_, **__):
        raise FlightError("there is no wind today")

    simulate(refuse)
    assert cli.main(["run", "short.toml", "--quiet"]) == codes.BAD_INPUT
    assert capsys.readouterr().err == "error: there is no wind today\n"


def test_bugs_are_not_hidden(capsys, monkeypatch, simulate):
    """An unexpected error is shown as the fault of the program that it is, with its place; all of it to developers."""
    simulate(lambda *_, **__: 1 // 0)
    assert cli.main(["run", "short.toml", "--quiet"]) == codes.BAD_INPUT
    told = capsys.readouterr().err
    assert told.startswith("error: ZeroDivisionError in test_cli.py, line ")
    assert "this is a bug in rigidfleet" in told
    flags = type("Flags", (), {"dev_mode": True})
    monkeypatch.setattr(
        "rigidfleet.cli.app.sys", type("Sys", (), {"flags": flags, "stderr": sys.stderr})
    )
    with pytest.raises(ZeroDivisionError):
        cli.main(["run", "short.toml", "--quiet"])


def test_full_memory_is_no_fault(capsys, simulate):
    """What does not fit into memory is said in a sentence, with a remedy."""

    def grow(*_, **__):
        raise MemoryError

    simulate(grow)
    assert cli.main(["run", "short.toml", "--quiet"]) == codes.BAD_INPUT
    assert "not enough memory" in capsys.readouterr().err


def test_first_compile(capsys, monkeypatch):
    """A first compile says on standard error that it compiles, and a later flight does not."""
    words = "Compiling the simulator"
    for compiled in (False, True):
        monkeypatch.setattr(
            "rigidfleet.kernel.engine.native.has_machine_code", lambda c=compiled: c
        )
        assert cli.main(["run", "short.toml", "--no-figures", "--force"]) == codes.PASSED
        assert (words in capsys.readouterr().err) is not compiled


# -- interruption ------------------------------------------------------------------------------------


def test_interrupt():
    """On Ctrl-C a terminal's progress bar gives way, what flew is saved as incomplete, and it exits with 130."""
    write("long.toml", LONG)
    terminal, side = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "rigidfleet", "run", "long.toml"],
        stdout=subprocess.PIPE,
        stderr=side,
        env=os.environ | {"COLUMNS": "120", "TERM": "xterm"},
    ) as process:
        os.close(side)
        shown = b""
        while b"left  stand still" not in shown:  # time flown, speed, time left, phase
            shown += os.read(terminal, 4096)
        process.send_signal(signal.SIGINT)
        printed = process.communicate(timeout=60)[0].decode()
    try:
        while more := os.read(terminal, 4096):
            shown += more
    except OSError:  # the terminal's other end is closed
        pass
    assert process.returncode == codes.INTERRUPTED
    assert b" of 1e+08 s  x" in shown
    os.close(terminal)
    assert b"Interrupted: the flight so far is saved" in shown
    assert b"Traceback" not in shown
    assert "incomplete" in printed
    result = Result.load("flights/long/long.nc")
    assert not result.complete
    assert 1.0 < result.phases[-1].t_end < 1e8
    assert not Path("flights/long/figures").exists()


@pytest.mark.parametrize("during", ["render_figure", "write_file"])
def test_interrupt_of_drawing(capsys, monkeypatch, during: str):
    """Ctrl-C while figures are drawn or written leaves the flight as it is, and says so."""

    def draw(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"rigidfleet.plotting.{during}", draw)
    assert cli.main(["run", "short.toml"]) == codes.INTERRUPTED
    assert capsys.readouterr().err.startswith(
        "Interrupted: the complete flight is saved in flights"
    )
    assert Result.load("flights/short/short.nc").complete


def test_interrupt_inside_the_compiler(capsys, simulate):
    """Ctrl-C that comes out of the compiler as another error is Ctrl-C all the same."""

    def compile_for_long(*_, **__):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(10)
        except KeyboardInterrupt:
            raise RuntimeError("no compiled object yet") from None

    simulate(compile_for_long)
    before = signal.getsignal(signal.SIGINT)
    assert cli.main(["run", "short.toml", "--quiet"]) == codes.INTERRUPTED
    assert capsys.readouterr().err == "Interrupted\n"
    assert signal.getsignal(signal.SIGINT) is before


# -- report ------------------------------------------------------------------------------------------


@pytest.fixture
def plot(monkeypatch):
    """Draw figures in no time."""

    def draw(result, name, formats, *, titles=True, width=None):
        assert width in {None, 88.0}
        return dict.fromkeys(formats, b"drawn" if titles else b"bare")

    monkeypatch.setattr("rigidfleet.plotting.render_figure", draw)


@pytest.mark.parametrize("options", [[], ["--figures", "few"], ["--figures", "all"]])
def test_run_draws(capsys, plot, options):
    """A summary and a trajectory, or all that has something to show, go into a folder of their own, each as PNG."""
    assert cli.main(["run", "short.toml", *options]) == codes.PASSED
    found = {p.name for p in Path("flights/short/figures").iterdir()}
    known = figure_names(Result.load("flights/short/short.nc"))
    assert len(known) > 4
    drawn = known if "all" in options else ["summary", "trajectory"]
    assert found == {f"{name}.png" for name in drawn}
    where = os.path.join("flights", "short", "figures") + os.sep
    assert f"Figures  {where} ({len(found)} files)" in capsys.readouterr().out


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_verdict_is_printed_before_figures_are_drawn(capsys, monkeypatch, options):
    """When the first figure is begun, the verdict stands there already, in words or as JSON."""
    before = []

    def draw(result, name, formats, **_):
        before.append(capsys.readouterr().out)
        return dict.fromkeys(formats, b"drawn")

    monkeypatch.setattr("rigidfleet.plotting.render_figure", draw)
    assert cli.main(["run", "short.toml", *options]) == codes.PASSED
    assert len(before) == 2
    verdict = Path("flights/short/verdict.json").read_text(encoding="utf-8")
    assert before[0] == verdict if options else "Passed" in before[0]


@pytest.mark.parametrize("command", [["run", "short.toml"], ["report", "flights/short/short.nc"]])
@pytest.mark.parametrize("width", ["79", "1000", "nan", "-88"])
def test_width_of_figures(capsys, plot, command, width):
    """--width is checked before anything is flown or drawn."""
    assert cli.main(["run", "short.toml", "--width", "88"]) == codes.PASSED
    assert cli.main([*command, "--width", width, "--force"]) == codes.BAD_INPUT
    assert "--width must be 80 to 400 [mm]" in capsys.readouterr().err


def test_formats_and_titles_of_figures(capsys, plot):
    """--format, repeated, says which files are drawn, --no-titles how; what was drawn before is replaced or kept."""
    figures = Path("flights/short/figures")
    options = ["--format", "pdf", "--format", "svg", "--no-titles", "--figures", "all"]
    assert cli.main(["run", "short.toml", *options]) == codes.PASSED
    known = figure_names(Result.load("flights/short/short.nc"))
    assert {p.name for p in figures.iterdir()} == {
        f"{n}.{k}" for n in known for k in ("pdf", "svg")
    }
    assert {p.read_text(encoding="utf-8") for p in figures.iterdir()} == {"bare"}
    assert f"({2 * len(known)} files)" in capsys.readouterr().out
    png = ["--format", "png", "--figures", "all"]
    assert cli.main(["run", "short.toml"]) == codes.BAD_INPUT, "the PDFs are files of that flight"
    assert cli.main(["report", "flights/short/short.nc", *png]) == codes.PASSED
    assert (figures / "cm.png").read_text(encoding="utf-8") == "drawn"
    assert (figures / "cm.svg").read_text(encoding="utf-8") == "bare"
    assert cli.main(["run", "short.toml", "--force", "--format", "png"]) == codes.PASSED
    assert {p.suffix for p in figures.iterdir()} == {".png"}
    capsys.readouterr()
    assert cli.main(["run", "short.toml", "--format", "bmp"]) == codes.BAD_INPUT
    assert '"png", "svg", "pdf"' in capsys.readouterr().err


@pytest.mark.long
def test_demo(folder):
    """The demonstration passes its verdict, may be repeated, and leaves every figure that is wanted."""
    for _ in range(2):
        done = command("run", "narrow-passage", "--force", "--figures", "all")
        assert done.returncode == codes.PASSED, done.stderr
    figures = folder / "flights" / "narrow-passage" / "figures"
    found = {path.name for path in figures.iterdir() if path.stat().st_size > 10_000}
    known = figure_names(Result.load(figures.parent / "narrow-passage.nc"))
    assert found == {f"{name}.png" for name in known}


def test_report(capsys, plot):
    """A report gives the verdict again, draws what is missing, and keeps what is there."""
    cli.main(["run", "short.toml", "--no-figures"])
    verdict = Path("flights/short/verdict.json")
    capsys.readouterr()
    write(verdict, "earlier")
    figures = Path("flights/short/figures")
    figures.mkdir()
    write(figures / "cm.png", "earlier")
    assert cli.main(["report", "flights/short/short.nc", "--figures", "all"]) == codes.PASSED
    out, err = capsys.readouterr()
    assert "Passed" in out
    assert "2 existing files kept" in err
    for path, text in (
        (verdict, "earlier"),
        (figures / "cm.png", "earlier"),
        (figures / "clearance.png", "drawn"),
    ):
        assert path.read_text(encoding="utf-8") == text
    known = figure_names(Result.load("flights/short/short.nc"))
    assert len(list(figures.iterdir())) == len(known)


def test_report_force(capsys, plot):
    """With --force a report replaces verdict and figures; with --out it leaves them alone."""
    cli.main(["run", "short.toml"])
    verdict = Path("flights/short/verdict.json")
    text = verdict.read_text(encoding="utf-8")
    write(verdict, "earlier")
    assert cli.main(["report", "flights/short/short.nc", "--out", "deep/down"]) == codes.PASSED
    assert Path("deep/down/verdict.json").read_text(encoding="utf-8") == text
    assert verdict.read_text(encoding="utf-8") == "earlier"
    assert cli.main(["report", "flights/short/short.nc", "--force"]) == codes.PASSED
    assert verdict.read_text(encoding="utf-8") == text
    assert "kept" not in capsys.readouterr().err


def test_report_page(capsys, plot):
    """A report is a page beside the result, which is kept, replaced with --force, and gone with its flight."""
    cli.main(["run", "short.toml", "--no-figures", "--quiet"])
    page = Path("flights/short/report.html")
    assert cli.main(["report", "flights/short/short.nc", "--no-figures"]) == codes.PASSED
    assert f"Report   {page}" in capsys.readouterr().out
    assert "Hold a triangle for a second" in page.read_text(encoding="utf-8")
    assert not Path("flights/short/figures").exists()
    write(page, "earlier")
    cli.main(["report", "flights/short/short.nc", "--no-figures"])
    assert page.read_text(encoding="utf-8") == "earlier"
    cli.main(["report", "flights/short/short.nc", "--no-figures", "--force"])
    assert page.read_text(encoding="utf-8") != "earlier"
    cli.main(["run", "short.toml", "--no-figures", "--quiet", "--force"])
    assert not page.exists()


def test_replay(capsys, plot):
    """A replay is a page beside the result, which is kept, replaced with --force, and gone with its flight."""
    assert cli.main(["run", "short.toml", "--no-figures", "--replay"]) == codes.PASSED
    page = Path("flights/short/replay.html")
    assert f"Replay   {page} (open it in a browser)\n" in capsys.readouterr().out
    write(page, "earlier")
    assert cli.main(["replay", "flights/short/short.nc"]) == codes.BAD_INPUT
    assert "already exists; use --force to overwrite" in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == "earlier"
    assert cli.main(["replay", "flights/short/short.nc", "--force"]) == codes.PASSED
    assert capsys.readouterr().out == f"Replay   {page} (open it in a browser)\n"
    assert "Hold a triangle for a second" in page.read_text(encoding="utf-8")
    assert cli.main(["replay", "flights/short/short.nc", "--out", "to-send.html"]) == codes.PASSED
    assert Path("to-send.html").read_bytes() == page.read_bytes()
    cli.main(["run", "short.toml", "--no-figures", "--quiet", "--force"])
    assert not page.exists()


def test_live(capsys, monkeypatch):
    """A live flight says where it is to be seen, and opens the browser unless told not to."""
    asked = []

    def fly(mission, *, port, browser, ready, landed):
        asked.append((mission.name, port, browser))
        ready("http://127.0.0.1:1/secret/")

    monkeypatch.setattr(import_module("rigidfleet.web.live"), "live", fly)
    assert cli.main(["live", "short.toml"]) == codes.PASSED
    assert cli.main(["live", "narrow-passage", "--port", "8000", "--no-browser"]) == codes.PASSED
    assert asked == [("short", 0, True), ("narrow-passage", 8000, False)]
    out = capsys.readouterr().out
    assert "Flying short at http://127.0.0.1:1/secret/\n" in out


def test_live_needs_slots(capsys):
    """A mission that has no slots to fly by hand is refused."""
    chain = (
        'edges = [[1, 2], [2, 3]]\ndistances = [4.0, 4.0]\n[[phases]]\nreference = "distances"\n'
    )
    text = TRIANGLE.replace(
        'shape = "triangle"\nsize = 4.0\n[[phases]]\n', chain + 'control = "open"\n'
    )
    write("chain.toml", text.replace("blend = 0.5", "blend = 1.0"))
    assert cli.main(["live", "chain.toml", "--no-browser"]) == codes.BAD_INPUT
    assert "no formation has slots" in capsys.readouterr().err


def test_report_json_and_quiet(capsys, plot):
    """With --json a report prints the verdict's file and nothing else; with --quiet nothing."""
    cli.main(["run", "short.toml", "--no-figures", "--quiet"])
    assert cli.main(["report", "flights/short/short.nc", "--json"]) == codes.PASSED
    verdict = Path("flights/short/verdict.json").read_text(encoding="utf-8")
    assert capsys.readouterr().out == verdict
    assert cli.main(["report", "flights/short/short.nc", "--quiet"]) == codes.PASSED
    assert capsys.readouterr() == ("", "")


def test_report_of_a_flight_that_failed(plot):
    """The report of a flight that failed its verdict exits with 1."""
    write("bad.toml", SPEEDING)
    cli.main(["run", "bad.toml", "--no-figures", "--quiet"])
    assert cli.main(["report", "flights/short/short.nc"]) == codes.FAILED


def test_report_of_several(capsys, plot):
    """Several flights make one page, named by what tells them apart; one that failed makes the exit code 1."""
    write("bad.toml", SPEEDING)
    results = []
    for name in ("short", "bad"):
        cli.main(["run", f"{name}.toml", "--no-figures", "--quiet", "--out", name])
        results.append(f"{name}/short.nc")
    assert cli.main(["report", *results]) == codes.FAILED
    out = capsys.readouterr().out
    assert "\nbad: Failed" in f"\n{out}"
    assert "\nshort: Passed" in f"\n{out}"
    assert "Report   comparison.html" in out
    text = Path("comparison.html").read_text(encoding="utf-8")
    assert "short/short" not in text
    assert not list(Path().rglob("report.html"))
    assert cli.main(["report", *results]) == codes.BAD_INPUT
    assert "comparison.html: already exists" in capsys.readouterr().err
    assert cli.main(["report", *results, "--force", "--json"]) == codes.FAILED
    assert [verdict["passed"] for verdict in json.loads(capsys.readouterr().out)] == [True, False]
    assert cli.main(["report", *results, "--out", "side/by/side", "--quiet"]) == codes.FAILED
    assert Path("side/by/side/comparison.html").exists()


# -- the screen --------------------------------------------------------------------------------------


def test_piped_output_is_plain():
    """What goes to a pipe has no colours and no animation, and no row of a table is broken that fits COLUMNS."""
    done = command("missions", TERM="xterm-256color", COLUMNS="160")
    assert "\x1b" not in done.stdout + done.stderr
    assert len(done.stdout.splitlines()) == 1 + len(GROUPS) + len(mission_names()) + 2


@pytest.mark.parametrize("arguments", [["missions"], ["missions", "--schema"], ["--help"]])
def test_reader_went_away(arguments):
    """A reader that has had enough, as `head` has, is no error."""
    reader, writer = os.pipe()
    os.close(reader)
    done = command(*arguments, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="there is no /dev/full here")
@pytest.mark.parametrize("arguments", [["missions"], ["missions", "--schema"]])
def test_output_onto_a_full_disk(arguments):
    """Output that cannot be written is one clear error."""
    with open("/dev/full", "w") as full:
        done = command(*arguments, stdout=full)
    assert done.returncode == codes.BAD_INPUT
    assert done.stderr == "error: standard output: No space left on device\n"


def test_simple_terminal():
    """Signs that the terminal lacks are replaced, and do not end the program."""
    done = command("check", "narrow-passage", PYTHONIOENCODING="ascii")
    assert done.returncode == codes.PASSED
    assert "yaw 90?" in done.stdout


def test_no_color(capsys, monkeypatch):
    """On a terminal errors are coloured, unless NO_COLOR is set."""
    monkeypatch.setenv("FORCE_COLOR", "1")
    for value, coloured in (("", True), ("1", False)):
        monkeypatch.setenv("NO_COLOR", value)
        console.console.cache_clear()
        cli.main(["run", "sqare"])
        assert ("\x1b[1;31m" in capsys.readouterr().err) is coloured


def test_progress_words(monkeypatch):
    """Progress says the time flown, the speed against real time, the time left and the phase."""
    monkeypatch.setattr(console, "perf_counter", lambda: 0.0)
    watch = console.FlightWatch()
    watch.update(Progress(0.0, 90.0, "WP0", 1.0))
    assert watch._progress_text() == "0.0 of 90 s  WP0"
    watch.update(Progress(30.0, 90.0, "WP3", 3.0))
    assert watch._progress_text() == "30.0 of 90 s  x15  0:04 left  WP3"
    watch.update(Progress(30.5, 90.0, "WP3", 23.0))
    assert watch._progress_text() == "30.5 of 90 s  x0.03  39:40 left  WP3"
    watch.update(Progress(90.0, 90.0, "WP3", 24.0))
    assert watch._progress_text() == "90.0 of 90 s  WP3"


def test_progress_of_phases_that_differ(monkeypatch):
    """A phase flown in no time says nothing of the next one: the time left grows while a flight stands still."""
    now = 0.0
    monkeypatch.setattr(console, "perf_counter", lambda: now)
    monkeypatch.setattr(console, "_SELDOM", 1e9)
    watch = console.FlightWatch()
    watch.update(Progress(0.0, 81.0, "take off", 0.0))
    now = 0.1
    watch.update(Progress(12.0, 81.0, "sphere", 0.1, planning=True))
    assert watch._progress_text() == "12.0 of 81 s  sphere  (planning)"
    now = 4.0
    assert watch._progress_text() == "12.0 of 81 s  x3.0  0:23 left  sphere  (planning)"
    now = 10.2  # by now what was flown in no time is long ago
    assert watch._progress_text() == "12.0 of 81 s  sphere  (planning)"


def test_progress_leaves_compiling_out(monkeypatch):
    """The speed is that of flying: time without news, while the kernel compiles, does not count."""
    now = 0.0
    monkeypatch.setattr(console, "perf_counter", lambda: now)
    monkeypatch.setattr(console, "_SELDOM", 1e9)
    watch = console.FlightWatch()
    watch.announce_compilation()
    watch.update(Progress(0.0, 90.0, "WP0", 0.1))
    now = 12.0
    watch.update(Progress(10.0, 90.0, "WP0", 12.0))
    now = 12.9
    watch.update(Progress(20.0, 90.0, "WP1", 12.9))
    now = 13.4
    watch.update(Progress(24.0, 90.0, "WP1", 13.4))
    assert watch._progress_text() == "24.0 of 90 s  x10  0:07 left  WP1"


def test_progress_on_a_terminal(monkeypatch):
    """A terminal shows what is waited for, then per cent, time flown, speed, time left and phase, and is left clean."""
    now = 0.0
    monkeypatch.setattr(console, "perf_counter", lambda: now)
    screen = io.StringIO()
    watch = console.FlightWatch()
    watch.console = Console(file=screen, force_terminal=True, width=120, markup=False)

    def drawn() -> str:
        assert watch.progress is not None
        screen.truncate(0)
        watch.progress.refresh()
        return re.sub(r"\x1b\[[\d;?]*\w", "", screen.getvalue())

    with watch:
        assert "Starting: 0 s" in drawn()
        watch.announce_compilation()
        now = 7.0
        assert f"{console.COMPILING}: 7 s" in drawn()
        watch.update(Progress(0.0, 90.0, "[WP0]", 1.0))
        watch.update(Progress(30.0, 90.0, "[WP0]", 3.0))
        assert " 33% 30.0 of 90 s  x15  0:04 left  [WP0]" in drawn()
        now = 9.0
        assert f" 33% {console.COMPILING}: 9 s" in drawn()
    assert screen.getvalue().endswith("\x1b[2K")


def test_found_ways_are_written_once(tmp_path, capsys):
    """check --expand writes the mission with its ways, whole, and overwrites nothing unless forced."""
    file = tmp_path / "found.toml"
    asked = [
        "check",
        "narrow-passage-found",
        "--no-realisations",
        "--expand",
        str(file.with_suffix("")),
    ]
    assert cli.main(asked) == 0
    written = file.read_text()
    assert 'kind = "go"' not in written
    assert 'formation = "line"' in written
    assert f"Mission  {file}" in capsys.readouterr().out
    file.write_text("mine")
    assert cli.main(asked) == 2
    assert "--force" in capsys.readouterr().err
    assert file.read_text() == "mine"
    assert cli.main([*asked, "--force"]) == 0
    assert file.read_text() == written
