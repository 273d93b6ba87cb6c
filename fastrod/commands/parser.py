"""The words of a command from its function: an argparse parser by the signature and the docstring.

Positional parameters are words in their order, keyword-only ones are options. The first line of a docstring
is what lists of commands say. Below it each word has a line, with the name of its value and its meaning:

    LOG: run log of one robot
    --robot R: a shipped robot's name or a path to a .toml

Options that several commands have are fields of a frozen dataclass, which is then one parameter of each.
Annotations say how a word is read: `bool` is a flag, `Path`, `int` and `float` are one word, `Squares` are
7x5, `Pairs` are NAME=VALUE. A `Sequence` takes one or several, of tuples one at a time, and may come again.
"""

from __future__ import annotations

import argparse
import difflib
import inspect
import json
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from typing import Any, NoReturn

from fastrod.errors import InputError

Command = Callable[..., int]
"""Its exit code."""
Pairs = Mapping[str, object]
Squares = tuple[int, int]
"""Columns and rows of a board."""
_LINE = re.compile(r"(?:--)?([A-Za-z][\w-]*)((?: [A-Z][\w/:=]*)*): (.+)")


class UsageError(Exception):
    """Error that argparse would have printed over several lines."""


class Parser(argparse.ArgumentParser):
    """A parser whose error is one sentence."""

    def error(self, message: str) -> NoReturn:
        """Raise `UsageError`."""
        raise UsageError(f"{message}; `{self.prog} --help` says how it is used.")


@dataclass(frozen=True)
class Actions:
    """A command whose first word is an action: one function for each, and the one where none is named."""

    about: str
    functions: Mapping[str, Command]
    default: str = ""
    epilog: str = ""


def flags(group: Actions) -> set[str]:
    """Return the options of its actions that take no value."""
    words = [word for function in group.functions.values() for word in _words(function)]
    return {_flag(one) for one, _, hint in words if hint is bool}


def add_group(commands: Any, name: str, group: Actions) -> None:
    """Add a command with actions to `commands`, subparsers of argparse."""
    parser = commands.add_parser(
        name, help=_listed(group.about), formatter_class=argparse.RawDescriptionHelpFormatter
    )
    inner = parser.add_subparsers(dest="action", required=True, metavar="ACTION", help=argparse.SUPPRESS)
    for action, function in group.functions.items():
        add_command(inner, action, function)
    width = max(map(len, group.functions)) + 2
    lines = [f"  {one.dest:<{width}}{one.help}" for one in inner._get_subactions()]
    default = f" (default: {group.default})" if group.default else ""
    parser.usage = f"fastrod {name} {'[ACTION]' if group.default else 'ACTION'} [...]"
    parser.description = "\n".join([group.about, "", f"actions{default}:", *lines])
    parser.epilog = f"`fastrod {name} ACTION --help` lists the options of one.\n\n{group.epilog}"


def add_command(commands: Any, name: str, function: Command, more: Mapping[str, str] | None = None) -> None:
    """Add the words of a function to `commands`; `more` are options that it takes by `**`, and their
    meanings."""
    lines = (inspect.getdoc(function) or "").splitlines()
    about = lines[0] if lines else ""
    parser = commands.add_parser(name, help=_listed(about), description=about)
    parser.set_defaults(function=function, parser=parser)
    words = list(_words(function))
    documents = {hint for _, owner, hint in words if owner is not None for hint in owner.__mro__}
    for document in documents:
        lines += (inspect.getdoc(document) or "").splitlines()
    said = _said(lines)
    for one, _, hint in words:
        flag = _flag(one)
        positional = one.kind not in (one.KEYWORD_ONLY, one.VAR_KEYWORD)
        key = next((word for word in said if word.isupper()), "") if positional else flag
        values, meaning = said.pop(key, ((), ""))
        default = None if one.default is one.empty else one.default
        if default not in (None, "") and not isinstance(default, (bool, tuple)) and "default" not in meaning:
            meaning += f" (default: {default:g})" if isinstance(default, float) else f" (default: {default})"
        form = _form(hint, default) | {"help": meaning.replace("%", "%%")}
        if positional:
            number = "*" if one.kind is one.VAR_POSITIONAL else "?" if one.default is not one.empty else None
            parser.add_argument(one.name, metavar=key or one.name.upper(), nargs=number, **form)
            continue
        if form.get("action") != "store_true":
            form["metavar"] = (values[0] if len(values) == 1 else values) if values else "V"
        parser.add_argument(flag, dest=one.name, required=one.default is one.empty, **form)
    for option, meaning in (more or {}).items():
        parser.add_argument(f"--{option}", metavar="V", help=meaning)


def unknown_option(parser: argparse.ArgumentParser, word: str) -> UsageError:
    """The error for an option that a command does not have."""
    known = [option.lstrip("-") for option in parser._option_string_actions]
    near = difflib.get_close_matches(word.partition("=")[0].lstrip("-"), known, n=1)
    meant = f" did you mean '--{near[0]}'?" if near else ""
    return UsageError(f"{parser.prog} does not know {word!r};{meant} `{parser.prog} --help` lists them.")


def call(given: argparse.Namespace) -> int:
    """Call the function of a command line; its exit code."""
    values = dict(vars(given))
    function = values.pop("function")
    for key in ("parser", "command", "action"):
        values.pop(key, None)
    words: list[Any] = []
    options: dict[str, Any] = {}
    shared: dict[str, tuple[Any, dict[str, Any]]] = {}
    for one, owner, hint in _words(function):
        value = values.pop(one.name)
        if hint == Pairs:
            value = _pairs(value, f"--{one.name.rstrip('_')}")
        if owner is not None:
            shared.setdefault(owner.__name__, (owner, {}))[1][one.name] = value
        elif one.kind is one.VAR_POSITIONAL:
            words += value or []
        elif one.kind is one.KEYWORD_ONLY:
            options[one.name] = value
        else:
            words.append(value)
    return int(function(*(owner(**its) for owner, its in shared.values()), *words, **options, **values))


def _words(function: Command) -> Iterator[tuple[inspect.Parameter, Any, Any]]:
    """Each word: name, default and kind; the dataclass that it is a field of; its annotation without
    None."""
    hints = typing.get_type_hints(function)
    for one in inspect.signature(function).parameters.values():
        hint = hints[one.name]
        if is_dataclass(hint):
            inner = typing.get_type_hints(hint)
            for field in fields(hint):
                default = one.empty if field.default is MISSING else field.default
                word = inspect.Parameter(field.name, one.KEYWORD_ONLY, default=default)
                yield word, hint, _plain(inner[field.name])
        elif one.kind is not one.VAR_KEYWORD:
            yield one, None, _plain(hint)


def _flag(word: inspect.Parameter) -> str:
    return f"--{word.name.rstrip('_').replace('_', '-')}"


def _plain(hint: Any) -> Any:
    """An annotation without its None."""
    known = [kind for kind in typing.get_args(hint) if kind is not type(None)]
    return known[0] if type(None) in typing.get_args(hint) else hint


def _said(lines: Sequence[str]) -> dict[str, tuple[tuple[str, ...], str]]:
    """Names of the values and meaning of each word: LOG, --robot."""
    said: dict[str, tuple[tuple[str, ...], str]] = {}
    last = ""
    for line in lines:
        if found := _LINE.fullmatch(line):
            last = line.partition(found[2] or ":")[0].rstrip(":")
            said[last] = (tuple(found[2].split()), found[3])
        elif last and line.startswith(" "):
            said[last] = (said[last][0], f"{said[last][1]} {line.strip()}")
        else:
            last = ""
    return said


def _listed(about: str) -> str:
    """The first line of a docstring as a list has it."""
    return about[:1].lower() + about[1:].rstrip(".")


def _form(hint: Any, default: Any) -> dict[str, Any]:
    """The words of argparse for an annotation."""
    if hint is bool:
        return {"action": "store_true", "default": default}
    if hint == Pairs:
        return {"action": "append", "default": []}
    if hint is not str and typing.get_origin(hint) is Sequence:
        (inner,) = typing.get_args(hint)
        if typing.get_origin(inner) is tuple:
            numbers = typing.get_args(inner)
            return {"action": "append", "nargs": len(numbers), "type": numbers[0], "default": []}
        return {"action": "extend", "nargs": "+", "default": []}
    kinds = {int: _whole, Squares: _squares}
    return {"type": kinds.get(hint, hint), "default": default}


def _pairs(given: Sequence[str], flag: str) -> dict[str, object]:
    """NAME=VALUE as names and numbers, lists, true, false, none, or words."""
    options: dict[str, object] = {}
    for pair in given:
        name, equals, word = pair.partition("=")
        if not equals or not name:
            raise InputError(f"{flag} is {pair!r}; give NAME=VALUE.")
        try:
            options[name] = None if word in ("none", "None") else json.loads(word)
        except ValueError:
            options[name] = word
    return options


def _whole(word: str) -> int:
    """1000000, or 1e6."""
    try:
        return int(word)
    except ValueError:
        pass
    try:
        value = float(word)
        if value == int(value):
            return int(value)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{word!r} is not a whole number, such as 1000000 or 1e6")


def _squares(word: str) -> Squares:
    """7x5 as columns and rows."""
    columns, _, rows = word.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise argparse.ArgumentTypeError(f"{word!r} is not COLUMNSxROWS, such as 7x5")
    return int(columns), int(rows)
