"""A shortcut speaks for the methods that its own class, or one above it, wrote."""

from dnerf.core.shortcuts import speaks_for


class Base:
    def slow(self) -> int:
        return 1

    def other(self) -> int:
        return 2

    def quick(self) -> int:
        return 1


class Same(Base):
    pass


class Slow(Base):
    def slow(self) -> int:
        return 3


class Both(Slow):
    def quick(self) -> int:
        return 3


class Other(Both):
    def other(self) -> int:
        return 4


def test_shortcuts_speak_for_originals_that_are_not_overridden_below_them() -> None:
    found = {kind: speaks_for(kind(), "quick", "slow") for kind in (Base, Same, Slow, Both, Other)}
    assert found == {Base: True, Same: True, Slow: False, Both: True, Other: True}
    assert not speaks_for(Other(), "quick", "slow", "other")
    assert not speaks_for(Base(), "missing", "slow")
