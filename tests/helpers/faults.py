"""Makes faults during training on purpose: in tests at a small size, in `benchmarks.reliability` at full size."""

import contextlib
import dataclasses
import errno
import hashlib
import multiprocessing
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import gymnasium as gym
import keras
import numpy as np
import tensorflow as tf

from dqn_keras import Config, TrainingInterrupted, train
from dqn_keras.agent import make_agent
from dqn_keras.environments import CartPole
from dqn_keras.storage import checkpoint
from dqn_keras.storage import files as storage_files
from dqn_keras.storage.checkpoint import Checkpoints
from dqn_keras.storage.files import from_bytes, to_bytes
from dqn_keras.storage.identity import identity
from tests.helpers.runs import fingerprint

LOOPS = {"Gymnasium loop": lambda: gym.make("CartPole-v1"), "compiled episodes": CartPole}
CONFIG = Config(num_episodes=250, batch_size=32, memory_size=2_000, solved_reward=1e6)  # its memory overflows
SEED, EVERY = 3, 5


def half_targets(experiences, gamma, q_network, q_hat_network):
    """Returns own targets: a mean of Q and Q-hat."""
    values = (q_network(experiences.next_state) + q_hat_network(experiences.next_state)) / 2
    return experiences.reward + (1 - experiences.terminal_state) * gamma * tf.reduce_max(values, axis=-1)


class RunningScale(keras.losses.Loss):
    """Returns an own loss, with a variable that is part of the run's state."""

    def __init__(self):
        super().__init__()
        self.scale = tf.Variable(1.0)

    def call(self, y, q):
        self.scale.assign(0.99 * self.scale + 0.01 * tf.reduce_mean(tf.abs(y - q)))
        return tf.square(y - q) / self.scale


def _own_network(*layers):
    return keras.Sequential([keras.Input((4,)), *layers, keras.layers.Dense(2)])


def _convolution():
    layers = keras.layers
    return _own_network(layers.Reshape((2, 2, 1)), layers.Conv2D(3, 2, activation="relu"), layers.Flatten())


def _lstm():
    return _own_network(keras.layers.Reshape((4, 1)), keras.layers.LSTM(5))


def _normalized():
    return _own_network(keras.layers.Dense(16, "relu"), keras.layers.BatchNormalization())


def _scheduled():
    return keras.optimizers.Adam(keras.optimizers.schedules.ExponentialDecay(0.003, 100, 0.9), clipnorm=1.0)


OWN_PARTS = {  # a case has the name of its loop, and of its parts
    ("Gymnasium loop", "convolution, schedule"): lambda: {"q_network": _convolution(), "optimizer": _scheduled()},
    ("compiled episodes", "convolution, own loss"): lambda: {"q_network": _convolution(), "loss": RunningScale()},
    ("Gymnasium loop", "LSTM, own targets"): lambda: {"q_network": _lstm(), "targets": half_targets},
    ("compiled episodes", "LSTM, schedule"): lambda: {"q_network": _lstm(), "optimizer": _scheduled()},
    ("Gymnasium loop", "BatchNormalization, own loss"): lambda: {"q_network": _normalized(), "loss": RunningScale()},
    ("compiled episodes", "BatchNormalization, own targets"): lambda: {
        "q_network": _normalized(),
        "targets": half_targets,
    },
}


def play(case, folder, config=CONFIG, seed=SEED, env=None, resume=True, **arguments):
    """Trains or resumes a run of the campaign; a case is the name of a loop, or one of OWN_PARTS."""
    if case in OWN_PARTS:
        keras.utils.set_random_seed(0)  # the weights that the network starts with
        config, arguments = dataclasses.replace(config, num_episodes=100), OWN_PARTS[case]()
        case = case[0]
        warnings.filterwarnings("ignore", "q_network is called in inference mode")
    env = env or LOOPS[case]()
    return train(env, config, seed, checkpoint=folder, checkpoint_every=EVERY, resume=resume, verbose=0, **arguments)


def newest(folder):
    return max(Path(folder).glob("checkpoint-*.npz"))


def files(folder):
    """Returns the names of the files of a run, except the lock file, which always stays."""
    return sorted({path.name for path in Path(folder).iterdir()} - {".lock"})


def final_bits(folder):
    """Returns the digest of the last checkpoint: of weights, Adam, memory, random state, rewards and counters."""
    return hashlib.sha256(newest(folder).read_bytes()).hexdigest()


# Kills. A child process trains; SIGKILL ends it, at a random time or in the middle of a save.


def _train_in_child(case, folder, started, death):
    started.set()
    if death is not None:
        _die_in_save(*death)
    play(case, folder)


def _die_in_save(num_saves, num_lines, share):
    """Kills this process in the save after `num_saves`: before its line `num_lines` or, with a share, in mid-write."""
    saves, save = iter(range(num_saves + 1)), Checkpoints.save

    def tracer(frame, event, _):
        nonlocal num_lines
        if frame.f_code.co_filename not in (checkpoint.__file__, storage_files.__file__):
            return None
        if event == "line":
            num_lines -= 1
            if num_lines < 0:
                os.kill(os.getpid(), signal.SIGKILL)
        return tracer

    def write_a_part(path, content):
        with path.open("wb") as file:
            file.write(content[: int(share * len(content))])
        os.kill(os.getpid(), signal.SIGKILL)

    def save_and_die(self, agent):
        if next(saves) < num_saves:
            return save(self, agent)
        if share is not None:
            Path.write_bytes = write_a_part
        else:
            sys.settrace(tracer)
        save(self, agent)
        os.kill(os.getpid(), signal.SIGKILL)
        return None

    Checkpoints.save = save_and_die


def child_process(target, *arguments):
    """Starts a process that has imported the package and done nothing else."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["dqn_keras", "tests.helpers.faults"])
    started = context.Event()
    process = context.Process(target=target, args=(*arguments[:2], started, *arguments[2:]))
    process.start()
    started.wait()
    return process


def kill_campaign(folder, num_kills, num_in_saves, kills_per_run=10, seed=0, cases=tuple(LOOPS)):
    """Kills runs of these cases again and again, resuming them each time -> kills done, in saves, runs, differing runs.

    `num_in_saves` of the deaths, or a few more, are inside a save. After each the newest checkpoint must be whole.
    """
    rng, folder = random.Random(seed), Path(folder)
    references, seconds, references_folder = {}, {}, folder / "references"
    for case in cases:
        process = child_process(_train_in_child, case, references_folder / str(cases.index(case)), None)
        start = time.perf_counter()
        process.join()
        assert process.exitcode == 0
        seconds[case] = time.perf_counter() - start
        references[case] = final_bits(references_folder / str(cases.index(case)))

    killed = killed_in_saves = runs = differing = attempts = 0
    while killed < num_kills:
        case = cases[runs % len(cases)]
        run_folder = folder / f"run {runs}"
        for _ in range(min(kills_per_run, num_kills - killed)):
            attempts += 1
            is_in_save = killed_in_saves < num_in_saves and rng.random() < 1.5 * num_in_saves / num_kills
            is_in_save |= num_kills - killed <= num_in_saves - killed_in_saves
            death = None
            if is_in_save:
                death = (rng.randrange(1, 8), rng.randrange(60), rng.choice([None, rng.random()]))
            process = child_process(_train_in_child, case, run_folder, death)
            start = time.perf_counter()
            if not is_in_save:
                process.join(rng.uniform(0, seconds[case]))
                process.kill()
            process.join()
            if process.exitcode == 0:  # it finished before the kill
                seconds[case] = min(seconds[case], time.perf_counter() - start)
                break
            assert process.exitcode == -signal.SIGKILL, process.exitcode
            killed, killed_in_saves = killed + 1, killed_in_saves + is_in_save
            if list(run_folder.glob("checkpoint-*.npz")):
                from_bytes(newest(run_folder).read_bytes())
        process = child_process(_train_in_child, case, run_folder, None)
        process.join()
        assert process.exitcode == 0
        left = files(run_folder)
        is_tidy = len(left) == 2 and not any("partial" in name for name in left)
        differing += final_bits(run_folder) != references[case] or not is_tidy
        runs += 1
        shutil.rmtree(run_folder)
    return {"kills": killed, "of them inside a save": killed_in_saves, "runs": runs, "differing runs": differing}


# Corruption. The newest of two checkpoints is damaged. The older one must be loaded, with a warning.


def corrupted(content, rng):
    """Corrupts the bytes of a checkpoint in one way -> the way, the new bytes."""
    way = rng.choice(["bit flip", "bit flip in the zip's directory", "truncation", "tail", "swapped members", "zeros"])
    changed = bytearray(content)
    if way == "bit flip":
        changed[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    elif way == "bit flip in the zip's directory":
        start = content.index(b"PK\x01\x02")
        changed[rng.randrange(start, len(content))] ^= 1 << rng.randrange(8)
    elif way == "truncation":
        del changed[rng.randrange(len(content)) :]
    elif way == "tail":
        changed += rng.randbytes(rng.randrange(1, 100))
    elif way == "swapped members":
        names = rng.choice([(b"q_network/1", b"q_hat_network/1"), (b"optimizer/2", b"optimizer/4")])
        changed = changed.replace(names[0], b"\0").replace(names[1], names[0]).replace(b"\0", names[1])
    else:
        start = rng.randrange(len(content) - 32)
        changed[start : start + 32] = bytes(32)
    return way, bytes(changed)


def forged(content, rng):
    """Changes a checkpoint and gives it the right digest -> the way, the new bytes."""
    arrays, facts = from_bytes(content)
    name = rng.choice(sorted(arrays))
    way = rng.choice(["format", "shape", "dtype", "NaN", "missing array", "array too many", "missing fact", "counts"])
    if way == "format":
        facts["format"] += 1
    elif way == "shape":
        arrays[name] = np.stack([arrays[name]] * 2)
    elif way == "dtype":
        arrays[name] = arrays[name].astype(np.float16 if arrays[name].dtype != np.float16 else np.float64)
    elif way == "NaN":
        name = rng.choice(sorted(n for n in arrays if n.startswith("q_")))
        arrays[name] = arrays[name].copy()
        arrays[name].reshape(-1)[rng.randrange(arrays[name].size)] = rng.choice([np.nan, np.inf, -np.inf])
    elif way == "missing array":
        del arrays[name]
    elif way == "array too many":
        arrays["more"] = np.zeros(1)
    elif way == "missing fact":
        del facts[rng.choice(sorted(facts.keys()))]
    else:
        facts[rng.choice(["episodes_played", "num_appended"])] += rng.choice([-1, 1])
    return way, to_bytes(arrays, facts)


def corruption_campaign(folder, number, seed=0):
    """Corrupts checkpoints -> how often each way was tried, and how often it had no warning or a wrong result."""
    rng, folder = random.Random(seed), Path(folder)
    env, config = CartPole(), CONFIG
    source = folder / "source"
    play(None, source, env=env)
    good, older = newest(source).read_bytes(), min(source.glob("checkpoint-*.npz"))
    expected = from_bytes(older.read_bytes())[0]
    tried, silent = {}, []
    agent = make_agent((4,), 2, config, SEED)
    for _ in range(number):
        way, content = (corrupted if rng.random() < 0.8 else forged)(good, rng)
        if content == good:
            continue  # zeros replaced by zeros
        tried[way] = tried.get(way, 0) + 1
        newest(source).write_bytes(content)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            path = Checkpoints(source, identity(env, config, agent)).restore(agent, SEED)
        messages = [str(w.message) for w in caught]
        is_warned = (
            len(messages) == 1
            and str(newest(source)) in messages[0]
            and f"continues from the older {older}" in messages[0]
        )
        restored = checkpoint._arrays(agent, [])
        is_older = all(np.array_equal(restored[k], v, equal_nan=True) for k, v in expected.items())
        if path != older or not is_warned or not is_older:
            silent.append((way, path, messages))
    return {"corruptions": sum(tried.values()), "by way": tried, "silent": silent}


# Forgotten fields. Each part of a checkpoint in turn is left out, or reset to its value at the start.


def forgetting_campaign(loop, folder):
    """Returns, for each part, how a resume shows that it is missing, and that it is reset; '' if it does not."""
    folder = Path(folder)
    config = dataclasses.replace(CONFIG, num_episodes=80, memory_size=500)
    run = play(loop, folder / "reference", config)
    reference = final_bits(folder / "reference")
    play(loop, folder / "half", dataclasses.replace(config, num_episodes=40))
    arrays, facts = from_bytes(newest(folder / "half").read_bytes())
    fresh = make_agent((4,), 2, run.config, SEED)
    start_arrays, start_facts = checkpoint._arrays(fresh, []), checkpoint._counters(fresh)
    start_facts["rng"] = np.random.default_rng(0).bit_generator.state
    start_facts["seed"] = 0

    def outcome(arrays, facts):
        changed_folder = folder / "changed"
        shutil.rmtree(changed_folder, ignore_errors=True)
        changed_folder.mkdir()
        (changed_folder / newest(folder / "half").name).write_bytes(to_bytes(arrays, facts))
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                play(loop, changed_folder, config, seed=None)
        except ValueError:
            return "refused"
        if final_bits(changed_folder) != reference:
            return "other bits"
        return "warned" if caught else ""

    assert outcome(arrays, facts) == ""
    outcomes = {}
    for name, value in arrays.items():
        others = {k: v for k, v in arrays.items() if k != name}
        start = start_arrays[name] if start_arrays[name].shape == value.shape else np.zeros_like(value)
        if np.array_equal(start, value):  # such as the learning rate, which training does not change
            start = start + np.ones_like(start)
        outcomes[name] = outcome(others, facts), outcome({**others, name: start}, facts)
    for name in facts:
        others = {k: v for k, v in facts.items() if k != name}
        start = start_facts.get(name, {} if isinstance(facts[name], dict) else 0)
        outcomes[name] = outcome(arrays, others), outcome(arrays, {**others, name: start})
    return outcomes


# Saves that fail.


@contextlib.contextmanager
def failing(module, name, error, after=0):
    """Makes a function of a module raise an error from its call number `after` on."""
    original, calls = getattr(module, name), iter(range(10**9))

    def fails(*arguments, **keywords):
        if next(calls) >= after:
            raise error
        return original(*arguments, **keywords)

    setattr(module, name, fails)
    try:
        yield
    finally:
        setattr(module, name, original)


def _always(module, name, error):
    return lambda fault, folder: fault.enter_context(failing(module, name, error))


def _limit_file_sizes(fault, folder):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, hard))
    fault.callback(resource.setrlimit, resource.RLIMIT_FSIZE, (soft, hard))


def _put_folders_in_the_way(fault, folder):
    for k in range(15, 41, 5):
        path = folder / f"checkpoint-{k:010d}.npz"
        path.mkdir()
        fault.callback(path.rmdir)


def _fill(fault, folder):
    with contextlib.suppress(OSError), (folder / "filler").open("wb", buffering=0) as file:
        while file.write(bytes(1_000)):
            pass
    fault.callback((folder / "filler").unlink)


def _make_immutable(fault, folder):
    subprocess.run(["chattr", "+i", folder], check=True)
    fault.callback(subprocess.run, ["chattr", "-i", folder], check=True)


DISK_FAULTS = {  # each begins during a run, and ends with its stack
    "no space left on the device": _always(os, "fsync", OSError(errno.ENOSPC, "No space left on device")),
    "an input/output error": _always(Path, "write_bytes", OSError(errno.EIO, "Input/output error")),
    "a rename that fails": _always(os, "replace", PermissionError(errno.EACCES, "Permission denied")),
    "a limit of the file size": _limit_file_sizes,
    "folders where the files should be": _put_folders_in_the_way,
    "a disk that is full": _fill,
    "a folder that is read-only": _make_immutable,
}
NEED_RIGHTS = {  # commands that show whether this process can do it on this system
    "a disk that is full": (["mount", "-t", "tmpfs", "tmpfs"], ["umount"]),
    "a folder that is read-only": (["chattr", "+i"], ["chattr", "-i"]),
}


def is_possible(name, folder):
    """Returns whether this process may do this to a folder."""
    return all(
        shutil.which(words[0]) and subprocess.run([*words, folder], capture_output=True).returncode == 0
        for words in NEED_RIGHTS.get(name, ())
    )


def under_disk_fault(name, folder):
    """Trains in a folder whose disk fails from episode 12 on, then resumes on the working disk.

    -> both runs, the warnings of checkpoints in the first, and the files that it left.
    """
    config = dataclasses.replace(CONFIG, num_episodes=40)
    with contextlib.ExitStack() as disk:
        if name == "a disk that is full":
            subprocess.run(["mount", "-t", "tmpfs", "-o", "size=300k", "tmpfs", folder], check=True)
            disk.callback(subprocess.run, ["umount", folder], check=True)
        with contextlib.ExitStack() as fault, warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            begin = keras.callbacks.LambdaCallback(
                on_epoch_end=lambda epoch, _: DISK_FAULTS[name](fault, folder) if epoch == 11 else None
            )
            run = play("Gymnasium loop", folder, config, callbacks=[begin])
            left = [x for x in files(folder) if x != "filler" and not (folder / x).is_dir()]
        resumed = play("Gymnasium loop", folder, config)
    return run, resumed, [str(w.message) for w in caught if str(w.message).startswith("checkpoint")], left


def disk_campaign(folder):
    """Counts faults of the disk, faults without exactly one warning, files too many, and runs that differ."""
    folder, figures = Path(folder), {"faults": 0, "not one warning": 0, "litter": 0, "differing runs": 0}
    for k, name in enumerate(DISK_FAULTS):
        (folder / str(k)).mkdir()
        if not is_possible(name, folder / str(k)):
            continue
        run, resumed, messages, left = under_disk_fault(name, folder / str(k))
        figures["faults"] += 1
        figures["not one warning"] += len(messages) != 1
        figures["litter"] += len(left) != 2
        figures["differing runs"] += fingerprint(resumed) != fingerprint(run)
    return figures


# Signals.


def _train_and_report(loop, folder, started, report):
    started.set()
    try:
        play(loop, folder)
    except TrainingInterrupted as stop:
        Path(report).write_text("interrupted" if stop.run.interrupted else "ended")


def try_to_train(loop, folder, started, report):
    started.set()
    try:
        play(loop, folder)
    except ValueError as error:
        Path(report).write_text(str(error))
    else:
        Path(report).write_text("trained")


def race_campaign(folder, number):
    """Starts two processes at once in one folder -> pairs, refused ones, runs that differ from a single process."""
    folder, figures = Path(folder), {"pairs": 0, "refused by the lock": 0, "differing runs": 0}
    play("Gymnasium loop", folder / "alone")
    for k in range(number):
        processes = [
            child_process(try_to_train, "Gymnasium loop", folder / str(k), folder / f"{k} {i}") for i in range(2)
        ]
        for process in processes:
            process.join()
        messages = [(folder / f"{k} {i}").read_text() for i in range(2)]
        figures["pairs"] += 1
        figures["refused by the lock"] += sum("is in use" in x for x in messages)
        is_whole = "trained" in messages and final_bits(folder / str(k)) == final_bits(folder / "alone")
        figures["differing runs"] += not (is_whole and len(files(folder / str(k))) == 2)
    return figures


def _after_first_checkpoint(folder):
    """Waits for the first checkpoint of a run -> the time."""
    start = time.perf_counter()
    while not list(folder.glob("checkpoint-*.npz")):
        if time.perf_counter() > start + 120:
            raise TimeoutError(f"no checkpoint in {folder}")
        time.sleep(0.01)
    return time.perf_counter()


def signal_campaign(folder, number, seed=0):
    """Asks runs to stop by SIGINT and SIGTERM at random times: -> requests, how many stopped a run, differing runs.

    Those that stop none come when training has ended and its process has not.
    """
    rng, folder = random.Random(seed), Path(folder)
    figures = {"signals": 0, "runs stopped by them": 0, "differing runs": 0}
    seconds = {}
    for k in range(number):
        loop, kind = list(LOOPS)[k % 2], (signal.SIGINT, signal.SIGTERM)[k // 2 % 2]
        reference, run_folder, report = folder / f"reference {loop}", folder / f"run {k}", folder / f"report {k}"
        if not reference.exists():
            process = child_process(_train_in_child, loop, reference, None)
            start = _after_first_checkpoint(reference)
            process.join()
            seconds[loop] = time.perf_counter() - start
        process = child_process(_train_and_report, loop, run_folder, report)
        _after_first_checkpoint(run_folder)
        process.join(rng.uniform(0.2, 0.8 * seconds[loop]))  # compilation and training
        if process.is_alive():
            os.kill(process.pid, kind)
            figures["signals"] += 1
        process.join()
        figures["runs stopped by them"] += report.exists() and report.read_text() == "interrupted"
        play(loop, run_folder)
        figures["differing runs"] += final_bits(run_folder) != final_bits(reference)
    return figures
