"""Options: their list, and how flags, --set, files and dicts set them.

The effect of an option is tested with the stage that it belongs to.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

import reobj_track as rt
from reobj.config import GONE, as_config, every_option, read_config, with_option, write_config

OPTIONS = every_option(rt.Config())


def other_value(default: Any) -> Any:
    """A value that is not the default, of its type."""
    if default == "solids":  # the one text that is checked where it is set
        return "trails"
    if isinstance(default, bool):
        return not default
    return f"{default}x" if isinstance(default, str) else type(default)(default + 3)


def values(config: rt.Config) -> dict[str, Any]:
    """All options of a config by their names for --set."""
    found = {}
    for name in OPTIONS:
        section, _, field = name.rpartition(".")
        found[name] = getattr(getattr(config, section) if section else config, field)
    return found


def given(folder: Path, *words: object) -> rt.Config:
    """The options of a command line, by --save-config; the run itself has no video."""
    kept = folder / "kept.toml"
    words = ("run", folder / "none.mp4", "-o", folder / "out", "--save-config", kept, *words)
    assert rt.main([str(word) for word in words]) == 2
    return read_config(rt.Config(), kept)


def test_the_list_of_options_is_complete(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        rt.main(["--options"])
    lines = capsys.readouterr().out.splitlines()
    assert done.value.code == 0 and max(map(len, lines)) <= 120
    assert [line.partition("=")[0] for line in lines if line[0] != " "] == list(OPTIONS)
    flags = [f.metadata["flag"] for f in OPTIONS.values() if f.metadata["flag"]]
    assert len(set(flags)) == len(flags)


def test_every_option_can_be_set_and_every_flag_sets_its_own(tmp_path: Path) -> None:
    wanted = {name: other_value(f.default) for name, f in OPTIONS.items()}
    words = [word for name, value in wanted.items() for word in ("--set", f"{name}={value}")]
    assert values(given(tmp_path, *words)) == wanted
    words = []
    for name, f in OPTIONS.items():
        if flag := f.metadata["flag"]:
            words += [flag] if f.default is False else [flag, str(wanted[name])]
    flagged = {name: bool(f.metadata["flag"]) for name, f in OPTIONS.items()}
    expected = {n: wanted[n] if flagged[n] else f.default for n, f in OPTIONS.items()}
    assert values(given(tmp_path, *words)) == expected
    with pytest.raises(SystemExit):  # no flag of objects
        rt.main(["track", "a.mp4", "-o", "out", "--priors", "p.json"])


@pytest.mark.parametrize(
    ("text", "value"), [("true", True), ("On", True), ("1", True), ("no", False), ("OFF", False)]
)
def test_switches_accept_words(text: str, value: bool) -> None:
    assert with_option(rt.Config(), "output.doubtful", text).output.doubtful is value


WRONG = [
    ("tracker", "coast_frame", "3", "no such option; did you mean tracker.coast_frames?"),
    ("traker", "n_init", "3", "did you mean tracker.n_init?"),
    ("quite", "different", "3", "no such option"),
    ("tracker", "n_init", "three", "expected a whole number, 0 or more, found 'three'"),
    ("tracker", "n_init", "2.5", "expected a whole number, 0 or more, found"),
    ("tracker", "n_init", "true", "expected a whole number, 0 or more, found"),
    ("tracker", "high_score", "nan", "expected a number, 0 or more, found"),
    ("tracker", "high_score", "-1", "expected a number, 0 or more, found"),
    ("output", "scene", "maybe", "expected true or false, found 'maybe'"),
    ("output", "overlay", "solid", "expected true or false"),
]


@pytest.mark.parametrize(("section", "field", "value", "expected"), WRONG)
def test_an_invalid_option_gives_one_line(
    section: str, field: str, value: str, expected: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """On the command line, in a file, and in a dict."""
    plain = value in ("true", "nan") or value[-1].isdigit()
    (tmp_path / "a.toml").write_text(f"[{section}]\n{field} = {value if plain else repr(value)}\n")
    run = ["run", "a.mp4", "-o", str(tmp_path / "out")]
    for more in (
        ["--set", f"{section}.{field}={value}"],
        ["--config", str(tmp_path / "a.toml")],
    ):
        assert rt.main([*run, *more]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and expected in said and f"{section}.{field}" in said
    with pytest.raises(rt.ReobjError, match=f"{section}.{field}"):
        rt.run("a.mp4", config={section: {field: value}})
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "expected"),
    [("[tracker", "not valid TOML"), ("threads = " + "9" * 5000, "not valid TOML"), (None, "read")],
)
def test_an_invalid_file_is_refused(tmp_path: Path, text: str | None, expected: str) -> None:
    if text is not None:
        (tmp_path / "a.toml").write_text(text)
    with pytest.raises(rt.ReobjError, match=rf"a\.toml: .*{expected}"):
        read_config(rt.Config(), tmp_path / "a.toml")


def test_options_of_earlier_versions_are_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.toml").write_text("threads = 2\n[detect]\ntiles = true\n")
    words = ("--config", tmp_path / "a.toml", "--set", "poses.max_gap=3")
    assert given(tmp_path, *words) == rt.Config(threads=2)
    said = capsys.readouterr().err
    assert said.count("note: ") == 2 and "detect.tiles" in said and "poses.max_gap" in said
    assert not set(GONE) & set(OPTIONS)


def test_a_file_keeps_every_option_and_holds_changed_values_only(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    config = rt.Config()
    for name, f in OPTIONS.items():
        config = with_option(config, name, other_value(f.default))
    write_config(config, path)
    assert read_config(rt.Config(), path) == config
    assert tomllib.loads(path.read_text())["tracker"]["n_init"] == 6
    write_config(rt.Config(threads=3, tracker=rt.TrackerConfig(n_init=4)), path)
    assert path.read_text().splitlines()[1:] == ["threads = 3", "", "[tracker]", "n_init = 4"]


@pytest.mark.parametrize(
    "text", ['a "b" c', "back\\slash", "größe \U0001f600", "tab\tline\nend\x7f\x01", "", "p\udcff"]
)
def test_any_text_survives_a_file(tmp_path: Path, text: str) -> None:
    """Also a path that is not UTF-8."""
    config = with_option(rt.Config(), "objects.priors", text)
    write_config(config, tmp_path / "a.toml")
    assert read_config(rt.Config(), tmp_path / "a.toml") == config


def test_flags_override_the_file_and_set_overrides_flags(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text("threads = 2\n[input]\nevery = 5\nstart = 7\n[tracker]\nhigh_score = 1\n")
    config = given(tmp_path, "--config", path, "--every", 3, "--start", 4, "--set", "input.start=8")
    assert (config.threads, config.input.every, config.input.start) == (2, 3, 8)
    assert config.tracker.high_score == 1.0 and type(config.tracker.high_score) is float


def test_a_dict_gives_options_by_section_or_name() -> None:
    chosen = {"detect": {"classes": ["chair", "cup"]}, "tracker.n_init": 2, "offline": True,
              "objects": {"prior": {"vcr": "tv", "mixer": "1x2x3m"}}}  # fmt: skip
    config = as_config(rt.Config(threads=3), chosen)
    assert (config.detect.classes, config.tracker.n_init) == ("chair,cup", 2)
    assert (config.offline, config.threads) == (True, 3)
    assert config.objects.prior == "vcr=tv,mixer=1x2x3m"
    assert as_config(config, None) is config and as_config(rt.Config(), config) is config
    assert rt.Tracker({"n_init": 2}).config == rt.TrackerConfig(n_init=2)
    for wrong in ({7: 1}, {"detect": {"classes": None}}, "a.toml", rt.TrackerConfig()):
        with pytest.raises(rt.ReobjError, match="config"):
            rt.run("a.mp4", config=wrong)  # type: ignore[arg-type]
