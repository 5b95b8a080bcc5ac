"""Every public function checks its arguments: a bad one is an error that begins with the argument's name."""

import inspect

import pytest

import dqn_keras
from dqn_keras import Run
from tests.helpers.fuzz import DOORS, Door, fuzz, in_its_own_folder, number, outcome, quiet_folder

RECORDS = {"Agent", "Episode", "Experience", "Run", "Study", "Sweep", "TrainingInterrupted"}  # made by the package


@pytest.fixture(scope="module", autouse=True)
def _quiet():
    with quiet_folder():
        yield


def test_every_argument_of_every_public_function_is_tried():
    names = set(dqn_keras.__all__) - RECORDS - {"environments", "presets", "__version__"}
    functions = {name: getattr(dqn_keras, name) for name in names}
    functions |= {f"ReplayMemory.{x}": getattr(dqn_keras.ReplayMemory, x) for x in ("append", "sample", "sample_rows")}
    functions |= {"Run.act": Run.act, "Run.save": Run.save}
    for name, function in functions.items():
        assert set(DOORS[name].claims) == set(inspect.signature(function).parameters) - {"self"}, name


@pytest.mark.parametrize("name", DOORS)
def test_right_arguments_are_accepted(name):
    with in_its_own_folder():
        DOORS[name].call(**DOORS[name].arguments())


def failures_of(found):
    return found["foreign"] + found["nonsense"] + found["refused"]


def test_a_bad_argument_is_an_error_that_names_it():
    found = fuzz(2_000)
    assert not (failures := failures_of(found)), "\n".join(failures)
    assert found["clear"] > 1_500


def naming(x):
    if not isinstance(x, float):
        raise TypeError(f"x must be a float, got {x!r}")


def of_another_name(x):
    raise ValueError(f"y must be a float, got {x!r}")


@pytest.mark.parametrize(
    ("function", "value", "kind"),
    [
        (naming, "'x'", "clear"),
        (naming, "0.5", "accepted"),
        (naming, "nan", "nonsense"),
        (naming, "0", "refused"),
        (lambda x: x + 1, "'x'", "foreign"),
        (of_another_name, "'x'", "foreign"),
        (naming, "[0.5] * 100_000", "foreign"),  # the message is 500,000 characters long
        (naming, "an unprintable object", "foreign"),
    ],
)
def test_the_fuzz_distinguishes_a_clear_error_from_others(function, value, kind):
    assert outcome(Door(function, lambda: {"x": 0.5}, {"x": number(0, 1)}), "x", value)[0] == kind
