"""Line numbers of the keys of a TOML text, which the TOML parser does not provide."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

_TOKEN = re.compile(
    r'"""(?:[^\\]|\\.)*?"""|\'\'\'.*?\'\'\'|"(?:[^"\\\n]|\\.)*"|\'[^\'\n]*\'|#[^\n]*|[\[\]{},=\n]|[^\s\[\]{},=#"\']+',
    re.DOTALL,
)
_Token = tuple[str, int]


def number_lines(text: str) -> dict[str, int]:
    r"""Return the line, counted from 1, of each key and list element by its dotted path.

    Args:
        text: A valid TOML text.

    Example:
        >>> number_lines('a = 1\n[[b]]\nc = [\n  2,\n  { d = 3 },\n]')
        {'a': 1, 'b': 2, 'b.0': 2, 'b.0.c': 3, 'b.0.c.0': 4, 'b.0.c.1': 5, 'b.0.c.1.d': 5}
    """
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    tokens = _Tokens(text)
    table = ""
    while (token := tokens.next()) is not None:
        word, line = token
        if word == "\n":
            continue
        if word == "[":
            several = (tokens.peek() or ("", 0))[0] == "["
            name = _join_path(_resolve_indices(counts, tokens.key(("]",))))
            if several:
                tokens.next()
                number = counts[name] = counts.get(name, -1) + 1
                lines.setdefault(name, line)
                name = f"{name}.{number}"
            lines.setdefault(name, line)
            table = name
            continue
        path = _join_path([table, *tokens.key(("=",), word)])
        lines.setdefault(path, line)
        _value(tokens, path, lines)
    return lines


def find_line(field: str, lines: Mapping[str, int]) -> int | None:
    """Return the line of a field, of its first part, or of the innermost enclosing table; None if there is none."""
    if (parts := [line for name, line in lines.items() if name.startswith(f"{field}.")]) and field not in lines:
        return min(parts)
    while field not in lines and "." in field:
        field = field.rpartition(".")[0]
    return lines.get(field)


class _Tokens:
    def __init__(self, text: str) -> None:
        self._all = list(_tokens(text))
        self._at = 0

    def peek(self) -> _Token | None:
        return self._all[self._at] if self._at < len(self._all) else None

    def next(self) -> _Token | None:
        self._at += 1
        return self._all[self._at - 1] if self._at <= len(self._all) else None

    def key(self, ends: tuple[str, ...], word: str = "") -> list[str]:
        """Read the parts of a key up to and including its end token."""
        parts = _parts(word)
        while (token := self.next()) is not None and token[0] not in ends:
            parts += _parts(token[0]) if token[0] != "[" else []
        return parts


def _tokens(text: str) -> Iterator[_Token]:
    line, last = 1, 0
    for match in _TOKEN.finditer(text):
        line += text.count("\n", last, match.start())
        last = match.start()
        if not match[0].startswith("#"):
            yield match[0], line


def _parts(word: str) -> list[str]:
    if word[:1] in "\"'" and word:
        return [word[1:-1]]
    return [part for part in word.split(".") if part]


def _join_path(parts: list[str]) -> str:
    return ".".join(part for part in parts if part)


def _resolve_indices(counts: Mapping[str, int], parts: list[str]) -> list[str]:
    """Return the path of a heading, with the index of the latest table of each enclosing list."""
    levels: list[str] = []
    for number, part in enumerate(parts):
        levels.append(part)
        name = _join_path(levels)
        if name in counts and number < len(parts) - 1:
            levels.append(str(counts[name]))
    return levels


def _value(tokens: _Tokens, path: str, lines: dict[str, int]) -> None:
    """Skip a value and store the lines of its elements."""
    opening = tokens.next()
    if opening is None or opening[0] not in "[{":
        return
    listed, number = opening[0] == "[", 0
    while (upcoming := tokens.peek()) is not None:
        word, line = upcoming
        if word in ("]", "}", ",", "\n"):
            tokens.next()
            if word in "]}":
                return
            continue
        inner = f"{path}.{number}" if listed else _join_path([path, *tokens.key(("=",))])
        number += 1
        lines.setdefault(inner, line)
        _value(tokens, inner, lines)
