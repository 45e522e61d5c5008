"""Feeds every reader mutated files and every verb odd command lines, and counts failures.

    python tools/fuzz/run.py [--minutes 10] [--calls N] [--seed 1] [--workers 2] [--only READER]
                             [--keep DIR]

With the same seed and number of workers, the k-th call of a reader is the same on every machine.
--calls limits the calls of each reader, with one call of a verb for every ten: what passed for an
hour here cannot fail in CI by chance.

Failures are tracebacks, calls of more than 10 s of processor time (30 s where they ignore signals)
or five minutes in total, more than 2 GB of memory, processes that die, and unfinished outputs; the
file or command line of each is kept. The exit status is 0 without failures.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from multiprocessing import get_context
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(Path(__file__).parent)]

from corpus import build  # noqa: E402
from mutate import mutated  # noqa: E402
from readers import (  # noqa: E402
    Reader,
    readers,
)
from verbs import VerbFuzzer  # noqa: E402

CALL_S = 10
SILENT_CPU_S, SILENT_S = 30, 300  # a busy computer takes time from a worker, not processor time
MEMORY = 2 * 1024**3
VERB_SHARE = 0.3
READER_CALLS_A_VERB = 10
VERBS = "verbs"


class Hang(BaseException):
    """A call exceeded its time."""


def main() -> int:
    """Runs the workers, restarts those that die, and prints the counts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument(
        "--calls", type=int, default=10**9, help="largest number of calls per reader"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument(
        "--only", default="", help="only readers whose name begins with this; no verbs"
    )
    parser.add_argument("--keep", type=Path, help="folder for failures")
    options = parser.parse_args()
    keep = options.keep or Path(tempfile.mkdtemp(prefix="cdpr-fuzz-"))
    keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="cdpr fuzz ") as folder:
        counts = _all(options, Path(folder), keep)
    return _report(counts, keep)


def _all(options: argparse.Namespace, folder: Path, keep: Path) -> Counter[str]:
    corpus = build(folder / "corpus")
    context = get_context("fork")
    end = time.monotonic() + 60.0 * options.minutes
    running: dict[int, Any] = {}
    starts = [0] * options.workers
    silences = [Silence() for _ in starts]
    while time.monotonic() < end + SILENT_S + CALL_S:
        for number in range(options.workers):
            worker = running.get(number)
            beat = folder / f"beat-{number}"
            if worker is not None and worker.is_alive():
                if silences[number].too_long(worker.pid, beat):
                    worker.kill()  # a call that ignores signals: counted as a dead worker below
                continue
            if worker is not None and worker.exitcode == 0:
                continue
            if worker is not None:
                _note(folder, keep, number, worker.exitcode)
                starts[number] += 1
            if time.monotonic() < end:
                beat.touch()
                task = (options, corpus, folder, keep, number, starts[number], end)
                running[number] = context.Process(target=_work, args=task)
                running[number].start()
        started = len(running) == options.workers
        if started and all(worker.exitcode == 0 for worker in running.values()):
            break
        if time.monotonic() > end and not any(w.is_alive() for w in running.values()):
            break
        time.sleep(0.5)
    total: Counter[str] = Counter()
    for file in folder.glob("counts-*.json"):
        total.update(json.loads(file.read_text()))
    return total


class Silence:
    """How long a worker has not changed its beat file."""

    def __init__(self) -> None:
        self._beat, self._since, self._used = 0, 0.0, 0.0

    def too_long(self, worker: int, beat: Path) -> bool:
        """Whether it is silent for longer than a call may take."""
        now, used, changed = time.monotonic(), _processor_s(worker), beat.stat().st_mtime_ns
        if changed != self._beat:
            self._beat, self._since, self._used = changed, now, used
        return used - self._used > SILENT_CPU_S or now - self._since > SILENT_S


def _processor_s(process: int) -> float:
    """Processor time of a process and of the children it waited for; 0.0 where it just ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return sum(int(field) for field in fields[11:15]) / os.sysconf("SC_CLK_TCK")


def _note(folder: Path, keep: Path, number: int, code: int) -> None:
    """Keeps the last input of a worker that died."""
    now = folder / f"now-{number}"
    shutil.copy(now, keep / f"died-{number}-{time.time_ns()}") if now.exists() else None
    file = folder / f"counts-died-{number}-{time.time_ns()}.json"
    file.write_text(json.dumps({"died": 1}))
    print(f"worker {number} died with {code}", file=sys.stderr)


def _work(
    options: argparse.Namespace,
    corpus: dict[str, list[Path]],
    folder: Path,
    keep: Path,
    number: int,
    start: int,
    end: float,
) -> None:
    sys.stdout = sys.stderr = (keep / f"worker-{number}.log").open("a")
    os.dup2(sys.stderr.fileno(), 2)  # what libraries print about damaged images
    scratch = folder / f"worker-{number}-{start}"
    scratch.mkdir()
    os.chdir(scratch)
    for name in ("TMPDIR", "XDG_RUNTIME_DIR", "XDG_STATE_HOME"):
        os.environ[name] = str(scratch)
    tempfile.tempdir = None
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGPROF, _too_long)
    chosen = [r for r in readers(corpus, scratch) if r.name.startswith(options.only)]
    verbs = None if options.only else VerbFuzzer(corpus, scratch)
    counts: Counter[str] = Counter()
    spent = {reader.name: 0.0 for reader in chosen} | ({} if verbs is None else {VERBS: 0.0})
    left = {name: _share(options, name == VERBS) for name in spent}
    made = dict.fromkeys(spent, 0)
    by_name = {reader.name: reader for reader in chosen}
    seeds = {reader.name: reader.seed.read_bytes() for reader in chosen}
    beat, now = folder / f"beat-{number}", folder / f"now-{number}"
    while time.monotonic() < end and any(left.values()):
        os.utime(beat)
        (folder / f"counts-{number}-{start}.json").write_text(json.dumps(counts))
        began = time.monotonic()
        # Equal time for each reader; verbs get `VERB_SHARE` of that of all readers.
        name = min(
            (name for name in left if left[name]),
            key=lambda name: (
                spent[name] * (1.0 / (VERB_SHARE * len(chosen)) if name == VERBS else 1.0)
            ),
        )
        while left[name] and time.monotonic() < began + 0.2:
            chance = random.Random(f"{options.seed} {name} {number} {start} {made[name]}")
            made[name], left[name] = made[name] + 1, left[name] - 1
            if name == VERBS:
                counts.update(_verb(verbs, chance, now, keep))
                continue
            data = mutated(seeds[name], chance)
            problem = _read(by_name[name], data, scratch, now)
            counts["reader calls"] += 1
            counts[f"calls of {name}"] += 1
            if problem:
                counts[problem[0]] += 1
                _keep(keep, name, data, problem)
        spent[name] += time.monotonic() - began
    (folder / f"counts-{number}-{start}.json").write_text(json.dumps(counts))


def _share(options: argparse.Namespace, of_verbs: bool) -> int:
    """Number of calls of one worker."""
    calls = options.calls // READER_CALLS_A_VERB if of_verbs else options.calls
    return max(1, calls // options.workers)


def _verb(verbs: VerbFuzzer, chance: random.Random, now: Path, keep: Path) -> list[str]:
    """Calls a verb once; returns the counters to increment."""
    found = verbs.one(chance, now)
    if any(one.startswith("verb ") for one in found):
        shutil.copy(now, keep / f"verb-{time.time_ns()}")
    return ["verb calls", *found]


def _read(reader: Reader, data: bytes, scratch: Path, now: Path) -> tuple[str, str] | None:
    """Calls a reader once; returns None, or the kind of failure and its trace."""
    from model.errors import CdprError

    path = reader.target or scratch / f"file{reader.seed.suffix}"
    path.write_bytes(data)
    now.write_bytes(data)
    signal.setitimer(signal.ITIMER_PROF, CALL_S)
    try:
        reader.read(path)
    except CdprError:
        return None
    except Hang:
        return "hangs", "".join(traceback.format_stack(limit=5))
    except MemoryError:
        return "out of memory", traceback.format_exc(limit=-8)
    except Exception:
        return "tracebacks", traceback.format_exc(limit=-8)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        if reader.target is not None:
            shutil.copyfile(reader.seed, path)
    return None


def _keep(keep: Path, name: str, data: bytes, problem: tuple[str, str]) -> None:
    """Keeps one file per cause, with its trace."""
    last = "\n".join(problem[1].strip().splitlines()[-4:])
    mark = f"{name.replace('/', '_')}-{problem[0]}-{abs(hash(last[:200])) % 10**8:08d}"
    if not (keep / f"{mark}.txt").exists() and len(list(keep.iterdir())) < 500:
        (keep / f"{mark}.bin").write_bytes(data)
        (keep / f"{mark}.txt").write_text(problem[1])


def _too_long(*_: object) -> None:
    raise Hang


def _report(counts: Counter[str], keep: Path) -> int:
    wrong = {
        key: count
        for key, count in counts.items()
        if key in ("tracebacks", "hangs", "out of memory", "died") or key.startswith("verb ")
        if key != "verb calls"
    }
    for key, count in sorted(counts.items()):
        print(f"{count:9d}  {key}")
    for trace in sorted(keep.glob("*.txt")):
        print(f"{trace.name}:\n{trace.read_text()}")
    if wrong:
        print(f"failures are in {keep}")
    print(f"{counts['reader calls']} reader calls, {counts['verb calls']} verb calls: ", end="")
    print(", ".join(f"{count} {key}" for key, count in wrong.items()) or "no failures")
    return 1 if wrong or not counts["reader calls"] else 0


if __name__ == "__main__":
    sys.exit(main())
