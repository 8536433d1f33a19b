"""Error messages for Python: arguments in place of configuration keys and options."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

from bayesdist.app.config import installed_kinds
from bayesdist.errors import BayesdistError

# arguments of `bayesdist.calibrate` by the configuration keys that they set
ARGUMENTS = {
    "assess.epoch": "epoch",
    "assess.exposure": "exposure",
    "data.matches": "matches",
    "data.sigma": "sigma",
    "detector.name": "name",
    "detector.scale_mas": "scale_mas",
    "detector.size": "size",
    "holdout.fraction": "held_out",
    "model.frames": "frames",
    "model.order": "order",
    "model.reference_pixel": "reference_pixel",
    "model.tdd": "time",
    "outliers.model": "outliers",
    "sampler.seed": "seed",
}
SECTIONS = {
    "[[budget]]": "catalogue and terms",
    "[[chip]]": "chips",
    "[[requirement]]": "requirements",
    "[holdout]": "held_out",
    "[outliers]": "outliers",
}
OPTIONS = {"force": "overwrite=True", "resume": "resume=True", "seed": "seed"}
# messages that name both the argument and the option are left as they are
_BILINGUAL = re.compile(r"in Python|on the command line|of convert")
_OPTION = re.compile(r"--(" + "|".join(OPTIONS) + r")\b")

P = ParamSpec("P")
R = TypeVar("R")


class HoldsRun(Protocol):
    """Object that knows whether its run was made in Python."""

    @property
    def folder(self) -> object | None:
        """Folder of the run, which has a configuration file; None if the run is in memory."""


Held = TypeVar("Held", bound=HoldsRun)


@contextmanager
def in_python_terms(*, keys: bool = True) -> Iterator[None]:
    """Context in which errors name arguments in place of options and of configuration keys.

    `keys` is False if keys are to be kept: those of a run made from a configuration file are
    correct.
    """
    try:
        yield
    except BayesdistError as error:
        error.where = _reworded(error.where, keys)
        error.cause, error.do = (_reworded(text, keys) for text in (error.cause, error.do))
        error.args = (error.sentence,)
        raise


def python_terms(
    method: Callable[Concatenate[Held, P], R],
) -> Callable[Concatenate[Held, P], R]:
    """Decorate a method of a run so that its errors are worded for Python."""

    @wraps(method)
    def worded(self: Held, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with in_python_terms(keys=self.folder is None):
            return method(self, *args, **kwargs)

    return worded


def _reworded(text: str, keys: bool) -> str:
    """Text with arguments in place of options and, if `keys` is True, of configuration keys."""
    if _BILINGUAL.search(text):
        return text
    text = _OPTION.sub(lambda match: OPTIONS[match[1]], text)
    if not keys:
        return text
    for section, argument in SECTIONS.items():
        text = text.replace(f"{section} blocks", argument).replace(f"a {section} block", argument)
        text = text.replace(section, argument)
    sections = sorted({name for kind in installed_kinds().values() for name in kind.model_fields})
    key = rf"(?<![\w./\[\"])({'|'.join(sections)})\.([a-z_]\w*)((?:\.\w+)*)"
    return re.sub(key, _argument, text) if sections else text


def _argument(match: re.Match[str]) -> str:
    """Argument that corresponds to a key: a separate one, or an entry of `settings`."""
    section, name, suffix = match[1], match[2], match[3]
    argument = ARGUMENTS.get(f"{section}.{name}")
    if argument is not None:
        return argument + suffix
    if section == "outliers":
        return f"outliers=OutlierMixture({name}=...)"
    return f'settings["{section}"]["{name}"]{suffix}'
