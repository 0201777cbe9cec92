"""Load missions by name or path; their JSON schema."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rigidfleet.errors import wrong_type
from rigidfleet.mission.files import inline_files
from rigidfleet.mission.model import Mission
from rigidfleet.mission.network import with_network
from rigidfleet.mission.schema import Start
from rigidfleet.mission.text import mission_names, mission_text, parse_toml, read_text


def load_mission(name_or_path: str | Path) -> Mission:
    """Read and check a mission: a shipped one by its name, or a file.

    The name of a shipped mission takes precedence over a file; write `./name` for the file.

    Raises
    ------
    MissionError
        There is no such mission, it cannot be read, or it has errors; `findings` has all of them.
    """
    if isinstance(name_or_path, str) and name_or_path in mission_names():
        return Mission.from_toml(mission_text(name_or_path), name_or_path)
    return mission_of_file(read_text(name_or_path), str(name_or_path))


def mission_of_file(text: str, origin: str) -> Mission:
    """The mission of the text of a file, and of the files that it names relative to that.

    Raises
    ------
    MissionError
        The text is no mission, or a file cannot be read.
    """
    data, text = inline_files(parse_toml(text, origin), text, Path(origin))
    return Mission.from_plain(data, origin, text=text)


def recorded_mission(text: str, origin: str) -> Mission:
    """The mission of a text that a result keeps; an earlier version may have written it.

    What it calls otherwise is taken without a warning, since nobody is going to change it.

    Raises
    ------
    MissionError
        With a finding for each error.
    """
    return Mission.from_plain(with_network(parse_toml(text, origin)), origin, text=text)


def as_mission(mission: Mission | str | Path) -> Mission:
    """Return the `Mission` that was given, or load it by its shipped name or path.

    Raises
    ------
    TypeError
        The argument is none of these.
    MissionError
        As `load_mission` does.
    """
    if isinstance(mission, Mission):
        return mission
    if isinstance(mission, str | Path):
        return load_mission(mission)
    raise wrong_type("a mission (a shipped name, a path or a Mission)", mission)


def json_schema() -> dict[str, Any]:
    """JSON schema of the mission format for editors, with the unit and meaning of every key."""
    draft = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema = Mission.model_json_schema()
    parts = schema["$defs"]
    parts["Start"] = Start.model_json_schema()
    # A shape of positions is replaced by its points before the model sees it, so the model does not have it.
    position = parts["Agents"]["properties"]["position"]
    listed = {key: position.pop(key) for key in ("type", "items", "minItems")}
    position["anyOf"] = [listed, {"$ref": "#/$defs/Start"}, {"type": "string"}]
    # So is the name of a file.
    parts["Formation"]["properties"]["slots"]["anyOf"].append({"type": "string"})
    return draft | schema
