"""The text of --help, the common settings on one page, and of --help-all, every setting by stage."""

from __future__ import annotations

import dataclasses
import sys
import textwrap
import types
import typing
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from _terminal import call_of, import_tyro, program
from fruitlangs.engine.setting import field_docs, level_of

WIDTH, COLUMN = 110, 34
"""Characters of a line, and of the column of flags."""
STAGES = {
    "scene": "Photos and cameras",
    "photos": "Cameras from photos alone",
    "train": "Training",
    "embed": "Features (these flags also work without their stage: --encoder clip)",
    "count": "Counting",
    "units": "Scale",
}
"""{stage: its heading}."""


def has_help_flag(given: Sequence[str]) -> bool:
    """Whether the arguments ask for either page."""
    return any(argument in ("-h", "--help", "--help-all") for argument in given)


def parse_arguments(kind: Any, default: Any, given: Sequence[str], script: str, example: str) -> Any:
    """Parse the arguments of a script (a dataclass, `kind`), or exit: 0 with a help page, 2 with a usage message.

    script: its file; example: the arguments of a usual call.
    """
    if has_help_flag(given):
        print(help_text(program(script), default, f"{call_of(script)} {example}", every="--help-all" in given))
        sys.exit(0)
    return import_tyro().cli(kind, args=given, default=default, prog=program(script), description=kind.__doc__)


def help_text(program: str, default: Any, example: str, *, every: bool) -> str:
    """The help page of a script.

    program: name of the script; default: its arguments (a dataclass with the stages' configs among its fields), whose
    values are shown as defaults; example: a command line; every: with all settings rather than the common ones.
    """
    stages = [field.name for field in dataclasses.fields(default) if field.name in STAGES]
    own = [field for field in dataclasses.fields(default) if field.name not in STAGES]
    docs, kinds = field_docs(type(default)), typing.get_type_hints(type(default), include_extras=True)
    flags = {field.name: _format_flag(field.name, kinds[field.name]) for field in own}
    flags[own[0].name] = flags[own[0].name].partition(" ")[2]  # positional
    required = [flags[field.name] for field in own if field.default is dataclasses.MISSING]
    lines = [f"usage: {program} {' '.join(required)} [options]", "", *_wrap(type(default).__doc__ or "", ""), ""]
    lines += ["Example:", f"  {example}", "", "Arguments:"]
    for field in own:
        lines += _format_entry(flags[field.name], docs[field.name], _format_default(default, field))
    lines += _format_entry("-h, --help", "Show this page.")
    if not stages:
        return "\n".join(lines)
    lines += _format_entry("--help-all", "Show every setting.")
    if not every:
        return "\n".join([*lines, "", "Common settings:", *_format_settings(default, stages, ("common",))])
    for stage in stages:
        lines += ["", f"{STAGES[stage]}:", *_format_settings(default, [stage], ("common", "advanced"))]
    lines += ["", "Experimental (for comparison with the paper's ablations):"]
    return "\n".join([*lines, *_format_settings(default, stages, ("experimental",))])


def _format_settings(default: Any, stages: Sequence[str], levels: Sequence[str]) -> Iterator[str]:
    for stage in stages:
        config = getattr(default, stage)
        docs, kinds = field_docs(type(config)), typing.get_type_hints(type(config))
        for field in dataclasses.fields(config):
            if level_of(field) in levels:
                flag = _format_flag(f"{stage}.{field.name}", kinds[field.name])
                yield from _format_entry(flag, docs[field.name], _format_default(config, field))


def _format_entry(flag: str, doc: str, default: str = "") -> list[str]:
    """Write a flag with its text to the right, or below it if the flag is long."""
    flag = f"  {flag.rstrip()}"
    text = list(_wrap(f"{doc} {default}".rstrip(), " " * COLUMN))
    if len(flag) + 2 > COLUMN:
        return [flag, *text]
    return [flag.ljust(COLUMN) + text[0][COLUMN:], *text[1:]]


def _wrap(text: str, indent: str) -> list[str]:
    return textwrap.wrap(" ".join(text.split()), WIDTH, initial_indent=indent, subsequent_indent=indent)


def _format_flag(name: str, kind: Any) -> str:
    """Write a flag with the placeholder of its value."""
    flag = name.replace("_", "-")
    if kind is bool:
        stage, dot, setting = flag.rpartition(".")
        return f"--{flag}, --{stage}{dot}no-{setting}"
    return f"--{flag} {_placeholder(kind)}"


def _format_default(values: Any, field: dataclasses.Field[Any]) -> str:
    """Write the default in brackets; nothing if the field is required, empty or not given."""
    value = getattr(values, field.name)
    if field.default is dataclasses.MISSING or value in (None, (), ""):
        return ""
    if isinstance(value, bool):
        return f"(default: {'on' if value else 'off'})"
    if isinstance(value, tuple):
        return f"(default: {' '.join(map(str, value))})"
    return f"(default: {value:g})" if isinstance(value, float) else f"(default: {value})"


def _placeholder(kind: Any) -> str:
    """The placeholder of a flag's value: its own name, its choices or its type, once per value."""
    for note in getattr(kind, "__metadata__", ()):
        if getattr(note, "metavar", None):
            return str(note.metavar)
    if typing.get_origin(kind) is typing.Annotated:
        kind = typing.get_args(kind)[0]
    choices = [choice for choice in typing.get_args(kind) if choice is not type(None)]
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return _placeholder(choices[0])
    if typing.get_origin(kind) is typing.Literal:
        return "{" + ",".join(map(str, choices)) + "}"
    if typing.get_origin(kind) is not tuple:
        return {int: "INT", float: "NUMBER", str: "TEXT", Path: "PATH"}[kind]
    single = _placeholder(choices[0])
    if Ellipsis in choices:
        return f"{single} …"
    return f"{single} ×{len(choices)}" if len(choices) > 2 else f"{single} {single}"
