"""A layout as TOML text, with a remark on each line: what `softneck import --guess` writes."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from softneck.core import FileFormatError, SettingsError
from softneck.core._budget import settings_text

from ._layout import FILE_KEYS, Layout, Source


def layout_toml(layout: Layout, *, remarks: Mapping[str, str] | None = None, open_ends: Sequence[str] = ()) -> str:
    """Return the TOML text of which `parse_layout` makes `layout` again.

    Args:
        layout: to write.
        remarks: channel (or `time`, `file`, `inclination`, `orientation`) -> why; becomes a comment.
        open_ends: lines that become comments at the end: what is still to be filled in.

    Raises:
        SettingsError: the time column is a sum of columns or has a sign, which a file cannot say.
    """
    why = remarks or {}
    blocks = [_file(layout, why), _time(layout, why)]
    simple = {name: source for name, source in layout.channels.items() if len(source.terms) == 1}
    # An empty table is written too: it tells a layout from other TOML files.
    lines = ["[channels]"]
    for name, source in simple.items():
        lines += [*_comment(why.get(name)), f"{name} = {_inline(source)}"]
    blocks.append(lines)
    for name, source in layout.channels.items():
        if name not in simple:
            blocks.append([*_comment(why.get(name)), f"[channels.{name}]", *_sum(source)])
    if layout.inclination is not None and layout.orientation is not None:
        tilt = ["[tilt]"]
        for name, source in (("inclination", layout.inclination), ("orientation", layout.orientation)):
            tilt += [*_comment(why.get(name)), f"{name} = {_inline(source)}"]
        blocks.append(tilt)
    if layout.quaternion is not None:
        axes = [f"{name} = {_text(getattr(layout.quaternion, name))}" for name in ("w", "x", "y", "z", "pitch", "roll")]
        blocks.append([*_comment(why.get("quaternion")), "[quaternion]", *axes])
    blocks.append([line for end in open_ends for line in _comment(end)])
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def _file(layout: Layout, why: Mapping[str, str]) -> list[str]:
    plain = Layout(channels={})
    said = {key: getattr(layout, key) for key in FILE_KEYS if getattr(layout, key) != getattr(plain, key)}
    lines = [f"{key} = {_text(value)}" for key, value in said.items()]
    return ["[file]", *_comment(why.get("file")), *lines] if lines else []


def _time(layout: Layout, why: Mapping[str, str]) -> list[str]:
    lines = _comment(why.get("time"))
    if layout.time is not None:
        if not layout.time.terms or layout.time.sign != 1.0:
            raise SettingsError("the time of a layout is one column without a sign; use its factor.")
        if len(layout.time.terms) == 1:
            term = layout.time.terms[0]
            lines += [f"column = {_text(term.column)}", f"unit = {_text(layout.time.unit)}"]
            lines += [f"factor = {term.factor!r}"] if term.factor != 1.0 else []
        else:
            lines += _sum(layout.time)
    lines += _comment(why.get("sample_time"))
    if layout.estimate:
        lines.append('sample_time_s = "estimate"')
    elif layout.sample_time is not None:
        lines.append(f"sample_time_s = {layout.sample_time!r}")
    rest = {"new_run_at_restart": layout.new_run_at_restart, "duplicates": layout.duplicates, "run_column": layout.run,
            "merge": layout.merge}  # fmt: skip
    lines += [f"{key} = {_text(value)}" for key, value in rest.items() if value is not None and value is not False]
    return ["[time]", *lines] if lines else []


def _inline(source: Source) -> str:
    if len(source.terms) != 1:
        return "{ " + ", ".join(_sum(source)) + " }"
    term = source.terms[0]
    parts = [f"column = {_text(term.column)}", f"unit = {_text(source.unit)}"]
    parts += [f"factor = {term.factor!r}"] if term.factor != 1.0 else []
    parts += [f"sign = {source.sign:g}"] if source.sign != 1.0 else []
    parts += ["integrate = true"] if source.integrate else []
    return "{ " + ", ".join(parts) + " }"


def _sum(source: Source) -> list[str]:
    terms = ", ".join(f"{{ column = {_text(t.column)}, factor = {t.factor!r} }}" for t in source.terms)
    return [
        f"unit = {_text(source.unit)}",
        f"terms = [{terms}]",
        *([f"sign = {source.sign:g}"] if source.sign != 1.0 else []),
        *(["integrate = true"] if source.integrate else []),
    ]


def _text(value: str | int | tuple[int, int]) -> str:
    """Return a string as TOML writes it, whole numbers, or true and false."""
    # JSON leaves DEL as it is, TOML does not.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _comment(text: str | None) -> list[str]:
    """Return comment lines; control characters, which a comment may not hold, become blanks."""
    if not text:
        return []
    return ["# " + "".join(c if c.isprintable() else " " for c in line) for line in text.splitlines()]


#: What a doubt in which outputs a robot has is about.
ONE_AXIS = "outputs"
# As a guess writes them: `NOT SURE (70 %): why` of a channel's column and unit, `NOT SURE: what (80 % sure): why` else.
_NOT_SURE = re.compile(r"NOT SURE(?: \((\d+ %)\))?: (.*?)(?=; NOT SURE|$)")
_KEY = re.compile(r"\[?(?:channels\.)?(\w+)")


def doubts_in(path: str | Path) -> tuple[str, ...]:
    """Return what a layout file marks as not sure, as `what (80 % sure): why`, which outputs there are first.

    Who looked and found a guess right removes its remark.
    """
    try:
        text = settings_text(path)
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: is not a layout ({error}).") from error
    found: dict[str, list[str]] = {}
    marked: list[str] = []
    for line in text.splitlines():
        key = None if line.startswith("#") else _KEY.match(line)
        marked += [line] * line.startswith("#")
        for sure, why in _NOT_SURE.findall(" ".join(marked)) if key else ():
            found.setdefault(f"({sure} sure): {why}" if sure else why, []).extend([key[1]] if sure and key else [])
        marked = [] if key else marked
    said = [" ".join([", ".join(keys), why]).strip() for why, keys in found.items()]
    return tuple(sorted(said, key=lambda one: not one.startswith(f"{ONE_AXIS}: ")))
