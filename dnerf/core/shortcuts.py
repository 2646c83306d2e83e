"""Shortcuts are taken only for what they were made for."""


def speaks_for(thing: object, shortcut: str, *originals: str) -> bool:
    """Whether a shortcut of an object still gives what its original methods give.

    A subclass that overrides an original, and not the shortcut, means something else than the class that wrote the
    shortcut knew of. Methods are given by name.
    """
    order = type(thing).__mro__

    def depth(name: str) -> int:
        return next((i for i, kind in enumerate(order) if name in vars(kind)), len(order))

    return all(depth(shortcut) <= depth(name) for name in originals)
