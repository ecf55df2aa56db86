"""Settings printed with what they mean: YAML that can be read by people and by ``--config``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, get_args, get_origin

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from laser_slam.config.sections import Config

_SIGNS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def explain_config(config: Config) -> str:
    """Return all settings as YAML, each with its meaning and limits as a comment.

    >>> from laser_slam.config import Config
    >>> print(explain_config(Config()).splitlines()[4])
    windows:  # Keyframes and overlapping windows.
    """
    return "\n".join(_lines(config, "")) + "\n"


def _lines(section: BaseModel, indent: str) -> Iterator[str]:
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, BaseModel):
            about = (type(value).__doc__ or "").strip().partition("\n")[0]
            yield f"{indent}{name}:{_comment(about)}"
            yield from _lines(value, indent + "  ")
        else:
            plain = section.model_dump(mode="json", include={name})[name]
            text = yaml.safe_dump([plain], default_flow_style=True, width=10**6).strip()
            yield f"{indent}{name}: {text[1:-1]}{_comment(_meaning(field))}"


def _comment(text: str) -> str:
    return f"  # {text}" if text else ""


def _meaning(field: FieldInfo) -> str:
    limits = [
        f"{sign} {getattr(rule, key):g}"
        for rule in field.metadata
        for key, sign in _SIGNS.items()
        if getattr(rule, key, None) is not None
    ]
    if get_origin(field.annotation) is Literal:
        limits.append(_choices(field.annotation))
    of = f" [{', '.join(limits)}]" if limits else ""
    return f"{field.description or ''}{of}".strip()


def _choices(annotation: Any) -> str:
    return " | ".join(str(choice) for choice in get_args(annotation))
