"""The one error that bad input raises, and how a command line shows it."""

from __future__ import annotations

import sys
from collections.abc import Callable

__all__ = ["InputError", "command_line"]


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


def command_line(main: Callable[[], None]) -> None:
    """Run ``main``; an `InputError` becomes one line on stderr and exit code 2, Ctrl-C exit code 130."""
    try:
        main()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
