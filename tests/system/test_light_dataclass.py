"""The light `dataclass`: its classes behave as those of the standard library."""

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


def make_both(call: str) -> tuple[Any, Any]:
    """The objects that the same call makes of the light and of the standard class."""
    kind, args, named = CALLS[call]
    return OURS[kind](*args, **named), THEIRS[kind](*args, **named)


def without_address(text: str) -> str:
    return text.partition(" at 0x")[0]


@pytest.mark.parametrize("call", CALLS)
def test_light_dataclass_has_the_fields_of_a_standard_one_in_their_order(call: str) -> None:
    ours, theirs = make_both(call)
    assert list(vars(ours).items()) == list(vars(theirs).items())
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)


@pytest.mark.parametrize("call", CALLS)
def test_light_dataclass_has_the_repr_of_a_standard_one(call: str) -> None:
    ours, theirs = make_both(call)
    assert without_address(repr(ours)) == without_address(repr(theirs))


@pytest.mark.parametrize("call", CALLS)
def test_light_dataclasses_of_one_call_are_equal_exactly_where_standard_ones_are(call: str) -> None:
    ours, theirs = make_both(call)
    ours_again, theirs_again = make_both(call)
    assert (ours == ours_again) == (theirs == theirs_again)


@pytest.mark.parametrize("call", CALLS)
def test_objects_of_different_classes_are_equal_only_by_an_eq_of_their_own(call: str) -> None:
    ours, theirs = make_both(call)
    assert (ours == theirs) == (call == "own functions")


@pytest.mark.parametrize("call", CALLS)
def test_copied_object_has_the_same_fields(call: str) -> None:
    ours, _ = make_both(call)
    assert vars(copy.copy(ours)) == vars(ours)


def describe_parameters(made: type) -> list[tuple[Any, ...]]:
    parameters = inspect.signature(made).parameters.values()
    return [(each.name, each.kind, each.annotation, each.default is each.empty) for each in parameters]


@pytest.mark.parametrize("kind", OURS)
def test_class_has_the_signature_of_the_standard_one(kind: str) -> None:
    assert describe_parameters(OURS[kind]) == describe_parameters(THEIRS[kind])
    assert OURS[kind].__match_args__ == THEIRS[kind].__match_args__


@pytest.mark.parametrize("kind", OURS)
def test_class_can_be_hashed_exactly_where_the_standard_one_can(kind: str) -> None:
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
def test_wrong_argument_raises_a_type_error_with_the_class_and_the_argument(name: str) -> None:
    kind, args, named, words = WRONG[name]
    with pytest.raises(TypeError):
        THEIRS[kind](*args, **named)
    with pytest.raises(TypeError, match=rf"^{kind}\(\): .*{words}"):
        OURS[kind](*args, **named)


@pytest.fixture(params=[OURS, THEIRS], ids=["light", "standard"])
def frozen_class(request: pytest.FixtureRequest) -> Any:
    """A frozen class derived from a frozen one, made by either decorator."""
    return request.param["Derived"]


@pytest.mark.parametrize("name", ["first", "third", "unknown"])
def test_frozen_object_takes_no_new_value_of_a_field(frozen_class: Any, name: str) -> None:
    frozen = frozen_class(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(frozen, name, 2)
    assert frozen == frozen_class(1)


def test_field_of_a_frozen_object_cannot_be_deleted(frozen_class: Any) -> None:
    frozen = frozen_class(1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        del frozen.first
    assert frozen.first == 1


def test_frozen_object_with_a_list_cannot_be_hashed(frozen_class: Any) -> None:
    with refused(TypeError, "unhashable"):
        hash(frozen_class(1, many=[2]))


def test_hash_leaves_out_a_field_that_is_not_compared(frozen_class: Any) -> None:
    assert hash(frozen_class(1, many=())) == hash(frozen_class(1, many=(), hidden=8))


def test_field_of_a_frozen_object_is_replaced_in_a_copy(frozen_class: Any) -> None:
    frozen = frozen_class(1)
    assert dataclasses.replace(frozen, third=2.0) == frozen_class(1, third=2.0) != frozen


@pytest.mark.parametrize("base", [OURS, THEIRS], ids=["of light", "of standard"])
@pytest.mark.parametrize("dataclass", [light_dataclass.dataclass, dataclasses.dataclass], ids=["light", "standard"])
class TestClassesDerivedByEitherDecorator:
    def test_frozen_class_derived_from_a_frozen_one_has_its_new_field(
        self, base: dict[str, Any], dataclass: Decorator
    ) -> None:
        own = dataclass(frozen=True)(type("Own", (base["Frozen"],), {"__annotations__": {"more": "int"}, "more": 4}))
        assert own(1, more=5).more == 5
        with pytest.raises(dataclasses.FrozenInstanceError):
            own(1).more = 2

    def test_class_that_is_not_frozen_cannot_be_derived_from_a_frozen_one(
        self, base: dict[str, Any], dataclass: Decorator
    ) -> None:
        with refused(TypeError, "frozen"):
            dataclass(type("Thawed", (base["Frozen"],), {}))


@light_dataclass.dataclass(frozen=True)
class Sent:
    """A class that pickle finds."""

    value: int
    rest: tuple[int, ...] = ()


class Extended(Sent):
    """No dataclass itself."""


def test_frozen_object_is_pickled_with_its_fields() -> None:
    assert pickle.loads(pickle.dumps(Sent(1, (2,)))) == Sent(1, (2,))


def test_plain_class_derived_from_a_frozen_one_takes_and_loses_other_attributes() -> None:
    extended: Any = Extended(3)
    extended.note = "kept"
    assert extended.note == "kept"
    del extended.note
    assert not hasattr(extended, "note")


def test_plain_class_derived_from_a_frozen_one_takes_no_new_value_of_a_field() -> None:
    extended = Extended(3)
    with pytest.raises(dataclasses.FrozenInstanceError):
        extended.value = 4  # type: ignore[misc]
    assert extended.value == 3
