import ast
import contextlib
import io
import re

import pytest

from tests.helpers.notebooks import NOTEBOOKS, render

STUDENTS, SOLUTIONS = render.convert(NOTEBOOKS / "exercises.py").values()
NUM_EXERCISES = 10


def code(notebook, tag=None):
    return [x.source for x in notebook.cells if x.cell_type == "code" and (tag is None or tag in render.tags(x))]


def signatures(cells):
    """Returns every function and class of some cells, with its arguments and docstring."""
    parts = [node for cell in cells for node in ast.walk(ast.parse(cell))]
    parts = [node for node in parts if isinstance(node, ast.FunctionDef | ast.ClassDef)]
    return {
        node.name: (ast.dump(node.args) if isinstance(node, ast.FunctionDef) else None, ast.get_docstring(node))
        for node in parts
        if node.name != "__init__"
    }


def test_the_students_version_holds_no_solution_and_no_output():
    assert not code(STUDENTS, "solution")
    assert not code(SOLUTIONS, "student")
    assert all(re.search("# your code here", cell) for cell in code(STUDENTS, "student"))
    rendered = render.nbformat.read(NOTEBOOKS / "exercises.ipynb", 4)
    assert not [cell for cell in rendered.cells if cell.get("outputs") or cell.get("execution_count")]


def test_both_versions_have_the_same_signatures_and_docstrings():
    asked, given = signatures(code(STUDENTS, "student")), signatures(code(SOLUTIONS, "solution"))
    assert len(asked) >= 9
    assert asked.items() <= given.items()


def test_every_exercise_has_a_time_and_a_check():
    headings = re.findall(r"^## (\d+)\..*\(\d+ minutes\)$", "\n".join(x.source for x in STUDENTS.cells), re.MULTILINE)
    checks = re.findall(r"^@check\((\d+)\)$", "\n".join(code(STUDENTS, "folded")), re.MULTILINE)
    assert headings == checks == [str(number) for number in range(1, NUM_EXERCISES + 1)]


@pytest.fixture(scope="module")
def machinery():
    """Returns the names that the checks need, from cells without training."""
    namespace = {}
    for cell in code(STUDENTS):
        if any(part in cell for part in ("from dqn_keras import", "class NotSolvedError", "def q_function")):
            exec(compile(cell, "cell", "exec"), namespace)
    return namespace


def verdict(machinery, number, answer, capsys):
    """Returns what the check of one exercise prints about an answer."""
    (cell,) = (x for x in code(STUDENTS, "folded") if f"@check({number})" in x)
    namespace = dict(machinery)
    exec(compile(answer, "answer", "exec"), namespace)
    exec(compile(cell, "check", "exec"), namespace)
    return capsys.readouterr().out


TARGETS = "def my_td_targets(experiences, gamma, q, q_hat):\n    s, a, r, s2, end = experiences\n    return "
DOUBLE = "def my_double_td_targets(experiences, gamma, q, q_hat):\n    s, a, r, s2, end = experiences\n    return "
MEMORY = """
class MyMemory:
    def __init__(self, size):
        self.size, self.transitions = size, []
    def append(self, transition):
        {append}
    def sample(self, batch_size, rng):
        {sample}
"""
KEEP = "self.transitions = [*self.transitions, transition][-self.size:]"
DRAW = "return [self.transitions[i] for i in rng.choice(len(self.transitions), batch_size, replace=False)]"
WRAPPER = """
class TimeLimitIsTerminal(gym.Wrapper):
    def step(self, action):
        state, reward, terminated, truncated, info = self.env.step(action)
        return state, reward, {ends}, info
"""
SWEEP = "from dqn_keras import Study\nprediction = 'more'\nby_tau = Sweep({{{}}})"
STUDIES = """from types import SimpleNamespace
from dqn_keras import Study
def a_study(tau, num_late):
    ends = num_late * [None] + (100 - num_late) * [250]
    steps = np.full(251, 20)
    runs = [SimpleNamespace(seed=k, solved_at=end, steps=steps, greedy_return=np.nan) for k, end in enumerate(ends)]
    return Study(Config(num_episodes=500, tau=tau), runs)
prediction = 'more'
by_tau = Sweep({'tau 0.01': a_study(0.01, 7), 'tau 1': a_study(1.0, 1)})
"""
SUM = """from types import SimpleNamespace
run = SimpleNamespace(q_network=make_q_network(4, 2, seed=0), config=Config())
wrong_state = {}
def discounted_return(rewards, gamma):
    return """
RIGHT_SUM = "sum(gamma**k * reward for k, reward in enumerate(rewards))"
PENALTY = """
class FallCosts(CartPole):
    def reward(self, state, action, next_state, rng, params=None):
        {body}
"""


BOUNDS = "gammas = (0.9, 0.95, 0.99); bounds = {}; weights_of_100 = {}"
RIGHT_WEIGHTS = [0.9**100, 0.95**100, 0.99**100]


@pytest.mark.parametrize(
    ("number", "answer", "message"),
    [
        (1, TARGETS + "None", "not solved yet"),
        (1, TARGETS + "r + gamma * tf.reduce_max(q_hat(s2), axis=-1)", "the future of a terminal state is worth 0"),
        (1, TARGETS + "r + (1 - end) * tf.reduce_max(q_hat(s2), axis=-1)", "gamma is missing"),
        (1, TARGETS + "r + (1 - end) * gamma * tf.reduce_max(q(s2), axis=-1)", "they should come from Q-hat"),
        (1, TARGETS + "r + (1 - end) * gamma * tf.reduce_mean(q_hat(s2), axis=-1)", "it takes the mean"),
        (1, TARGETS + "r + (1 - end) * gamma * tf.reduce_max(q_hat(s), axis=-1)", "those of the next states"),
        (1, TARGETS + "r + end * gamma * tf.reduce_max(q_hat(s2), axis=-1)", "are swapped"),
        (1, TARGETS + "(r + (1 - end) * gamma * tf.reduce_max(q_hat(s2), axis=-1))[:, None]", "have shape (6, 1)"),
        (1, TARGETS + "r + (1 - end) * gamma * np.max(q_hat(s2), axis=-1)", "TensorFlow cannot compile it"),
        (1, TARGETS + "r + 7", "instead of"),
        (1, TARGETS + "no_such_name", "NameError"),
        (1, TARGETS + "r + (1 - end) * gamma * tf.reduce_max(q_hat(s2), axis=-1)", ": solved."),
        (2, "prediction = by_tau = None", "write your prediction first"),
        (2, "prediction, by_tau = 'yes', None", "must be one of"),
        (2, "prediction, by_tau = 'fewer', None", "by_tau is missing"),
        (2, "prediction, by_tau = 'fewer', study", "by_tau must be the result of sweep, and is of type function"),
        (2, SWEEP.format("'a': Study(Config(), [])"), "call them"),
        (2, SWEEP.format("'tau 0.01': Study(Config(), []), 'tau 1': Study(Config(), [])"), "trained with tau=0.01"),
        (2, SWEEP.format("'tau 0.01': Study(Config(), []), 'tau 1': Study(Config(tau=1, gamma=0.9), [])"), "more than"),
        (2, SWEEP.format("'tau 0.01': Study(Config(), []), 'tau 1': Study(Config(tau=1), [])"), "too few"),
        (
            2,
            SWEEP.format("'tau 0.01': Study(Config(num_episodes=9), []), 'tau 1': Study(Config(), [])"),
            "9 episodes do",
        ),
        (2, STUDIES, "solved. You predicted 'more'"),
        (3, MEMORY.format(append="pass", sample="pass"), "append stores nothing"),
        (3, MEMORY.format(append=KEEP, sample="pass"), "sample returns nothing"),
        (3, MEMORY.format(append="self.transitions.append(transition)", sample=DRAW), "holds 8 transitions"),
        (3, MEMORY.format(append=KEEP.replace("-self.size:", ":self.size"), sample=DRAW), "the last five are"),
        (3, MEMORY.format(append=KEEP, sample=DRAW.replace("False", "True")), "draw without replacement"),
        (3, MEMORY.format(append=KEEP, sample="return self.transitions[-batch_size:]"), "60 % of the batches"),
        (3, MEMORY.format(append=KEEP, sample=DRAW), ": solved."),
        (4, DOUBLE + "r + (1 - end) * gamma * tf.reduce_max(q_hat(s2), axis=-1)", "Q should choose"),
        (4, DOUBLE + "r + (1 - end) * gamma * tf.reduce_max(q(s2), axis=-1)", "Q-hat should value it"),
        (4, DOUBLE + "r + (1 - end) * gamma * tf.gather(q(s2), tf.argmax(q_hat(s2), -1), batch_dims=1)", "swapped"),
        (4, DOUBLE + "r + (1 - end) * gamma * tf.gather(q_hat(s2), tf.argmax(q(s), -1), batch_dims=1)", "next states"),
        (4, DOUBLE + "r + (1 - end) * gamma * tf.gather(q_hat(s2), tf.argmax(q(s2), -1), batch_dims=1)", ": solved."),
        (5, WRAPPER.format(ends="terminated, truncated"), "when time is up, terminated must be True"),
        (5, WRAPPER.format(ends="truncated, False"), "when the pole falls, terminated must be True"),
        (5, WRAPPER.format(ends="terminated or truncated, truncated"), "truncated must be False"),
        (5, WRAPPER.format(ends="True, False"), "in the middle of an episode"),
        (5, WRAPPER.format(ends="terminated or truncated, False"), ": solved."),
        (6, SUM.format(None) + "None", "discounted_return returns nothing"),
        (6, SUM.format(None) + "sum(rewards)", "gamma is missing"),
        (6, SUM.format(None) + "gamma * " + RIGHT_SUM, "the first reward is discounted, too"),
        (6, SUM.format(None) + RIGHT_SUM, "wrong_state is missing"),
        (6, SUM.format([0, 0, 0]) + RIGHT_SUM, "a state is four numbers"),
        (6, SUM.format([2.5, 0, 0, 0]) + RIGHT_SUM, "the episode is over"),
        (6, SUM.format([0, 0, 0, 9]) + RIGHT_SUM, "stay within"),
        (6, SUM.format([0, 0, 0.2, 3]) + RIGHT_SUM, "they must differ by more than 3"),
        (6, SUM.format([0, 0, 0, 0]) + RIGHT_SUM, ": solved."),
        (7, PENALTY.format(body="pass"), "reward returns nothing"),
        (7, PENALTY.format(body="return tf.where(self.terminal(state, rng), -1.0, 1.0)"), "next_state has fallen"),
        (
            7,
            PENALTY.format(body="return tf.where(self.terminal(next_state, rng), 1.0, -1.0)"),
            "gives -1.0 instead of 1",
        ),
        (7, PENALTY.format(body="return -1.0 if self.terminal(next_state, rng) else 1.0"), "cannot compile"),
        (7, PENALTY.format(body="return tf.where(self.terminal(next_state, rng), -1.0, 1.0)"), ": solved."),
        (8, BOUNDS.format(None, None), "bounds is missing"),
        (8, BOUNDS.format("[10, 20, 100]", None), "weights_of_100 is missing"),
        (8, BOUNDS.format(10, RIGHT_WEIGHTS), "bounds must be a list of three numbers"),
        (8, BOUNDS.format("[10, 20, 100]", [0.9**100]), "weights_of_100 must be a list of three numbers"),
        (8, BOUNDS.format("[10, 20, 99]", RIGHT_WEIGHTS), "with gamma=0.99 the bound is 100, not 99"),
        (8, BOUNDS.format("[1 - g for g in gammas]", RIGHT_WEIGHTS), "that is 1 - gamma; divide 1 by it"),
        (8, BOUNDS.format("[10, 20, 100]", [90, 95, 99]), "100 times gamma"),
        (8, BOUNDS.format("[10, 20, 100]", [100 * w for w in RIGHT_WEIGHTS]), "the number in percent"),
        (8, BOUNDS.format("[10, 20, 100]", [1.0, 1.0, 1.0]), "it is 0.9^100 = 2.7e-05, not 1"),
        (8, BOUNDS.format("[10, 20, 100]", RIGHT_WEIGHTS), ": solved."),
        (9, "my_config = None", "my_config is missing"),
        (9, "my_config = {'solved_reward': 475}", "my_config must be a Config, and is dict"),
        (9, "my_config = Config()", "set solved_reward=475"),
        (9, "my_config = Config(solved_reward=None)", "set solved_reward=475"),
        (9, "my_config = Config(solved_reward=475, solved_window=1)", "may be luck"),
    ],
)
def test_a_check_says_what_is_wrong(machinery, number, answer, message, capsys):
    _, heading, said = verdict(machinery, number, answer, capsys).partition(f"Exercise {number}: ")
    assert heading
    assert message in heading + said


@pytest.mark.slow
def test_the_check_of_the_config_trains_five_seeds(machinery, capsys):
    printed = verdict(machinery, 9, "my_config = Config(solved_reward=475, num_episodes=60)", capsys)
    assert "not right yet: 0 of 5 seeds are solved (episodes: ['never', 'never', 'never', 'never', " in printed


@pytest.fixture(scope="module")
def unsolved():
    """Runs the students' version from top to bottom, with one seed for ten -> its names, what it prints."""
    namespace, printed = {}, io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(printed):
        patch.setenv("MPLBACKEND", "Agg")
        patch.chdir(NOTEBOOKS)
        for cell in code(STUDENTS):
            exec(compile(cell.replace("range(10)", "range(1)"), "notebook", "exec"), namespace)
    return namespace, printed.getvalue()


@pytest.mark.slow
def test_the_students_version_runs_from_top_to_bottom_unsolved(unsolved):
    for number in range(1, NUM_EXERCISES + 1):
        assert f"Exercise {number}: not solved yet: " in unsolved[1]
    assert "solved: 0 of 10" in unsolved[1]


@pytest.mark.slow
def test_the_check_of_the_probes_names_agent_and_probe(unsolved, capsys):
    namespace, printed = unsolved
    assert "'passes', 'passes', 'passes', 'passes', 'passes'" in printed
    none = dict.fromkeys("ABCDE")
    assert "A, B, C, D, E not repaired" in verdict(namespace, 10, f"repaired = {none}", capsys)
    for name, part, probe in (
        ("A", "targets_a", 5),
        ("B", "targets_b", 1),
        ("C", "choose_c", 4),
        ("D", "remember_d", 2),
    ):
        printed = verdict(namespace, 10, f"repaired = {none}\nrepaired['{name}'] = {part}", capsys)
        assert f"not right yet: {name} fails in probe {probe}: " in printed
    both = f"repaired = {none}\nrepaired['A'] = repaired['C'] = action"  # right for C, but no targets
    assert "Exercise 10: an error" in verdict(namespace, 10, both, capsys)
    assert "A, B, C, D not repaired" in verdict(namespace, 10, f"repaired = {none}\nrepaired['E'] = td_targets", capsys)
