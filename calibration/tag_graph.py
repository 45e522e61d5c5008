"""Which tags can be located: those that pictures tie to each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def connected_tags(pictures: Sequence[Iterable[int]], fixed: int | None = None) -> list[int]:
    """The largest group of tags that are tied by pictures that show two or more of them.

    Args:
        pictures: Numbers of the tags in each.
        fixed: A tag whose group is wanted instead.

    Returns:
        Their numbers in order; none where nothing was seen.
    """
    groups: list[set[int]] = []
    for numbers in map(set, pictures):
        tied = [group for group in groups if group & numbers]
        groups = [group for group in groups if not group & numbers]
        groups.append(numbers.union(*tied))
    if fixed is not None:
        groups = [group for group in groups if fixed in group]
    largest: set[int] = max(groups, key=lambda group: (len(group), -min(group)), default=set())
    return sorted(largest)
