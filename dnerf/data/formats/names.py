"""Frame numbers in the names of files."""

import re
from collections.abc import Sequence

MAX_DIGITS = 15  # more are exact in no float64


def frame_numbers(names: Sequence[str]) -> list[float] | None:
    """The last number of each name that is not the same in all; None if a name has none, or the numbers tell nothing.

    Names are those of files without suffix; of folders in them only the last part counts.
    """
    found = [re.findall(r"[0-9]+", name.rpartition("/")[2]) for name in names]
    if not found or not all(found) or any(len(digits) > MAX_DIGITS for group in found for digits in group):
        return None
    fewest = min(len(group) for group in found)
    for place in range(1, fewest + 1):
        values = [float(group[-place]) for group in found]
        if len(set(values)) > 1:
            return values
    return None
