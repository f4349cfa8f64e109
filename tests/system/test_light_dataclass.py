"""The light `dataclass`: whatever the classes are used for, they behave as those of the standard library."""

import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import pytest
from refusals import refused

from clrecon.system import light_dataclass

Decorator = Callable[..., Any]


def declare(dataclass: Decorator) -> dict[str, Any]:
    """The same classes, made by either decorator."""

    @dataclass(frozen=True)
    class Frozen:
        """A class of fields of all kinds."""

        first: int
        second: str = "b"
        many: list[int] = dataclasses.field(default_factory=list)
        hidden: int = dataclasses.field(default=7, repr=False, compare=False)
        made: int = dataclasses.field(default=5, init=False)
        shared: ClassVar[int] = 3

    @dataclass(frozen=True)
    class Derived(Frozen):
        third: float = 1.5

    @dataclass
    class Open:
        first: int
        second: int = 2

        def __post_init__(self) -> None:
            self.total = self.first + self.second

    @dataclass(eq=False, repr=False, kw_only=True)
    class Named:
        value: int
        other: int = 1

    @dataclass
    class OwnWords:
        value: int = 0

        def __repr__(self) -> str:
            return "own words"

        def __eq__(self, other: object) -> bool:
            return True

    @dataclass
    class Mixed:
        first: int
        _: dataclasses.KW_ONLY
        named: int = 2

    return {made.__name__: made for made in (Frozen, Derived, Open, Named, OwnWords, Mixed)}


OURS, THEIRS = declare(light_dataclass.dataclass), declare(dataclasses.dataclass)

CALLS: dict[str, tuple[str, tuple[Any, ...], dict[str, Any]]] = {
    "all defaults": ("Frozen", (1,), {}),
    "by place": ("Frozen", (1, "x", [2], 9), {}),
    "by name": ("Frozen", (), {"second": "y", "first": 4}),
    "derived": ("Derived", (1, "x"), {"third": 2.5}),
    "post init": ("Open", (1,), {}),
    "keywords only": ("Named", (), {"value": 3}),
    "own functions": ("OwnWords", (8,), {}),
    "keywords after a mark": ("Mixed", (1,), {"named": 5}),
}


def fields_without_addresses(text: str) -> str:
    return text.partition(" at 0x")[0]


@pytest.mark.parametrize("name", CALLS)
def test_an_object_has_the_fields_and_the_text_of_the_standard_one(name: str) -> None:
    kind, args, given = CALLS[name]
    ours, theirs = OURS[kind](*args, **given), THEIRS[kind](*args, **given)
    assert list(vars(ours).items()) == list(vars(theirs).items())
    assert fields_without_addresses(repr(ours)) == fields_without_addresses(repr(theirs))
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    assert (ours == OURS[kind](*args, **given)) == (theirs == THEIRS[kind](*args, **given))
    assert (ours == theirs) == (kind == "OwnWords")
    assert vars(copy.copy(ours)) == vars(ours)


@pytest.mark.parametrize("kind", OURS)
def test_a_class_has_the_signature_of_the_standard_one(kind: str) -> None:
    ours, theirs = inspect.signature(OURS[kind]), inspect.signature(THEIRS[kind])
    assert [(own.name, own.kind, own.annotation) for own in ours.parameters.values()] == [
        (own.name, own.kind, own.annotation) for own in theirs.parameters.values()
    ]
    has_default = [own.default is not inspect.Parameter.empty for own in ours.parameters.values()]
    assert has_default == [own.default is not inspect.Parameter.empty for own in theirs.parameters.values()]
    assert OURS[kind].__match_args__ == THEIRS[kind].__match_args__
    assert (OURS[kind].__hash__ is None) == (THEIRS[kind].__hash__ is None)


WRONG: dict[str, tuple[str, tuple[Any, ...], dict[str, Any], str]] = {
    "missing": ("Frozen", (), {}, "'first'"),
    "unknown": ("Frozen", (1,), {"third": 2}, "'third'"),
    "twice": ("Frozen", (1,), {"first": 2}, "'first'"),
    "too many": ("Open", (1, 2, 3), {}, "too many positional"),
    "by place though keyword only": ("Named", (1,), {}, "too many positional"),
    "a field that is not given": ("Frozen", (1,), {"made": 2}, "'made'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_a_type_error_that_names_class_and_argument(name: str) -> None:
    kind, args, given, words = WRONG[name]
    with pytest.raises(TypeError):
        THEIRS[kind](*args, **given)
    with pytest.raises(TypeError, match=rf"^{kind}\(\): .*{words}"):
        OURS[kind](*args, **given)


@pytest.mark.parametrize("classes", [OURS, THEIRS], ids=["light", "standard"])
def test_a_frozen_object_cannot_be_changed(classes: dict[str, Any]) -> None:
    frozen = classes["Derived"](1)
    for name in ("first", "third", "unknown"):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(frozen, name, 2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        del frozen.first
    assert frozen == classes["Derived"](1)
    with pytest.raises(TypeError, match="unhashable"):
        hash(frozen)
    assert hash(classes["Derived"](1, many=())) == hash(classes["Derived"](1, many=(), hidden=8))
    assert frozen != classes["Derived"](1, third=2.0)
    assert dataclasses.replace(frozen, third=2.0) == classes["Derived"](1, third=2.0)


@pytest.mark.parametrize("base", [OURS, THEIRS], ids=["light", "standard"])
@pytest.mark.parametrize("dataclass", [light_dataclass.dataclass, dataclasses.dataclass], ids=["light", "standard"])
def test_either_decorator_derives_from_either(base: dict[str, Any], dataclass: Decorator) -> None:
    own = dataclass(frozen=True)(type("Own", (base["Frozen"],), {"__annotations__": {"more": "int"}, "more": 4}))
    assert own(1, more=5).more == 5
    with pytest.raises(dataclasses.FrozenInstanceError):
        own(1).more = 2
    with refused(TypeError, "frozen"):
        dataclass(type("Thawed", (base["Frozen"],), {}))


@light_dataclass.dataclass(frozen=True)
class Sent:
    """A class that pickle finds."""

    value: int
    rest: tuple[int, ...] = ()


class Extended(Sent):
    """No dataclass itself."""


def test_objects_are_pickled_and_a_plain_class_derived_may_have_attributes() -> None:
    assert pickle.loads(pickle.dumps(Sent(1, (2,)))) == Sent(1, (2,))
    extended = Extended(3)
    extended.note = "kept"  # type: ignore[attr-defined]
    assert extended.note == "kept"  # type: ignore[attr-defined]
    del extended.note  # type: ignore[attr-defined]
    assert not hasattr(extended, "note")
    with pytest.raises(dataclasses.FrozenInstanceError):
        extended.value = 4  # type: ignore[misc]
