"""README and guide: links lead somewhere, commands are ones that the programs know, and the README stays short."""

import re
import shlex
from pathlib import Path

import pytest

import gelflow.cli
import synth.cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
APPS = {"synth": synth.cli.app, "gelflow": gelflow.cli.app}


def commands(page: Path) -> list[list[str]]:
    """The arguments of every `python -m synth` and `python -m gelflow` in a page's shell blocks."""
    found = []
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r" && | & ", line):
                words = shlex.split(part, comments=True)
                if words[:2] == ["python", "-m"] and words[2] in APPS:
                    found.append(words[2:])
    return found


def test_the_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 900
    assert [line for line in text.splitlines() if len(line) > 120] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page: Path) -> None:
    links = re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_commands_are_known() -> None:
    """Options are parsed as the programs parse them; nothing runs."""
    shown = [command for page in PAGES for command in commands(page)]
    assert len(shown) > 30
    for program, *arguments in shown:
        APPS[program].parse_args(arguments, exit_on_error=False, print_error=False)
