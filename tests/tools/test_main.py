"""The command line as a person meets it: help, mistakes, errors as one line, the exit codes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mavquad.errors import ConfigError
from tools import __main__ as tools_main

ROOT = Path(__file__).resolve().parents[2]


def test_help_lists_every_command_and_a_wrong_one_gets_the_nearest_name(capsys):
    assert tools_main.main(["--help"]) == 0
    shown = capsys.readouterr().out
    for name in tools_main.commands():
        assert name in shown
    assert tools_main.main([]) == 2
    assert tools_main.main(["papr"]) == 2
    assert 'did you mean "paper"?' in capsys.readouterr().err
    assert tools_main.main(["paper", "no-such-paper"]) == 2


@pytest.mark.parametrize("name", [n for n in tools_main.commands() if n not in (*tools_main.PROGRAMS, "paper")])
def test_every_command_has_help_with_an_example(name, capsys):
    assert tools_main.main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.count(f"mavquad {name}") >= 2  # the usage line and an example
    assert tools_main.main([name, "--no-such-option"]) == 2


def test_help_imports_neither_numpy_nor_rich_and_costs_little():
    code = (
        "import sys; from tools.__main__ import main; main(['--help']);"
        " print(sorted({'numpy', 'rich', 'numba', 'plotly', 'msgspec'} & set(sys.modules)), file=sys.stderr)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    spent = []
    for _ in range(3):
        before = os.times()
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
        after = os.times()
        spent.append(after.children_user + after.children_system - before.children_user - before.children_system)
        assert done.stderr.strip() == "[]"
    assert min(spent) <= 0.15  # CPU seconds, start of Python included


def test_an_error_of_ours_is_one_line_and_exit_1_and_a_ctrl_c_leaves_no_traceback(monkeypatch, capsys):
    def failing(words: list[str]) -> int:
        raise ConfigError("x.toml: no such file")

    def interrupted(words: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(tools_main, "_dispatch", failing)
    assert tools_main.main(["fly"]) == 1
    assert capsys.readouterr().err == "mavquad: x.toml: no such file\n"
    monkeypatch.setattr(tools_main, "_dispatch", interrupted)
    assert tools_main.main(["fly"]) == 1
    assert capsys.readouterr().err == "mavquad: stopped by Ctrl-C\n"


def test_output_into_a_closed_pipe_ends_quietly():
    command = f"{sys.executable} -m tools --help | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=ROOT, check=False)
    assert "Traceback" not in done.stderr
