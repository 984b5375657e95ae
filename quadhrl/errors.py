"""The one error that bad input raises, and how a command line shows it."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

__all__ = ["InputError", "check_range", "command_line"]


class InputError(ValueError):
    """Bad input from the user: names the field, the value found and the remedy.

    Args:
        field: the setting, flag or file at fault, as the user writes it.
        value: what was found there.
        remedy: what to do about it.
    """

    def __init__(self, field: str, value: object, remedy: str) -> None:
        self.field, self.value, self.remedy = field, value, remedy
        super().__init__(f"{field}: got {value!r}; {remedy}")


def check_range(
    config: object,
    section: str,
    fields: str,
    low: float,
    high: float = math.inf,
    unit: str = "",
    *,
    above: bool = False,
) -> None:
    """Check that fields of a config lie between ``low`` and ``high``.

    Args:
        config: the config.
        section: where its fields are on the command line: "terrain" for ``--terrain.gap-depth``, "" for ``--infill``.
        fields: names of the fields, separated by spaces.
        low: lower bound.
        high: upper bound.
        unit: unit to name in the message.
        above: the lower bound itself is not allowed.

    Raises:
        InputError: a field lies outside, or is NaN.
    """
    bound = f"above {low:g}" if above else f"of at least {low:g}"
    if high < math.inf:
        bound += f" and at most {high:g}"
    for field in fields.split():
        value = getattr(config, field)
        if not ((value > low if above else value >= low) and value <= high):
            flag = "--" + ".".join(filter(None, (section, field.replace("_", "-"))))
            raise InputError(flag, value, f"give a value {bound} {unit}".rstrip())


def command_line(main: Callable[[], None]) -> None:
    """Run ``main``; an `InputError` becomes one line on stderr and exit code 2, Ctrl-C exit code 130."""
    try:
        main()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
