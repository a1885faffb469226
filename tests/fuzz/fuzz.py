"""Look for damage that a reader does not stand, for as long as one likes.

``python -m tests.fuzz.fuzz READER --minutes 30 --seed 1`` writes into a folder, ``fuzz-READER``,
what it found and how often it read, and says how much of the reader's code that reached. With
`atheris` (``pip install '.[fuzz]'``) coverage guides what is tried, and the corpus is kept and gone
on with; without, the damage is random. ``--again FILE`` reads what was found again.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import importlib.util
import inspect
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import pcfix

SAY_EVERY_S = 30.0
KERNELS = ("pcfix.io.ply",)
"""Modules that numba compiles from, which nothing may be put into."""
BELOW = ("lens", "water", "label", "refract", "adjust", "clean", "grid", "compare", "simulate")
"""Rooms that compile, too; atheris takes what a module imports for a part of it."""


def main() -> None:
    given = _arguments()
    out = Path(given.out or "fuzz-" + given.reader.replace(" ", "-"))
    if given.again:
        again(given.reader, Path(given.again))
    elif given.child:
        run(given.reader, out, given.seconds, given.seed, given.child == "guided")
    elif given.replay:
        replay(given.reader, out)
    else:
        out.mkdir(parents=True, exist_ok=True)
        supervise(given.reader, out, 60.0 * given.minutes, given.seed, plain=given.plain)


def _arguments() -> Any:
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz.fuzz", description=__doc__)
    parser.add_argument("reader", help="see READERS of tests/faults/readers.py")
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", help="folder of corpus, findings and figures")
    parser.add_argument("--plain", action="store_true", help="random damage, with atheris too")
    parser.add_argument("--again", metavar="FILE", help="read one input, and show what happens")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--replay", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def supervise(reader: str, out: Path, seconds: float, seed: int, *, plain: bool) -> None:
    """Run children until the time is over, for one may end with its process; then count lines."""
    guided = not plain and importlib.util.find_spec("atheris") is not None
    if not (guided or plain):
        print("atheris is not installed: the damage is random, no coverage guides it", flush=True)
    began, ends = time.monotonic(), 0
    while (left := seconds - (time.monotonic() - began)) > 1.0:
        words = ["--child", "guided" if guided else "plain", "--seconds", f"{left:.0f}"]
        words += ["--seed", str(seed + ends), "--out", str(out)]
        done = subprocess.run([sys.executable, "-m", __spec__.name, reader, *words], check=False)
        if done.returncode and seconds - (time.monotonic() - began) > 1.0:
            ends += 1
            print(f"the process ended with {done.returncode}; see {out}/crash-*", flush=True)
            if ends == 20:
                break
    subprocess.run(
        [sys.executable, "-m", __spec__.name, reader, "--replay", "--out", str(out)], check=True
    )


class Log:
    """Counts, and what was found, each once, in the files of a folder."""

    def __init__(self, out: Path) -> None:
        self._out, self._began, self._cpu = out, time.monotonic(), time.process_time()
        self._path = out / "found.json"
        old = json.loads(self._path.read_text()) if self._path.exists() else {}
        self._before = {"executions": 0, "cpu_minutes": 0.0} | old
        self.found: dict[str, str] = old.get("found", {})
        self._executions, self._said, self._written = 0, 0.0, 0.0

    def count(self) -> None:
        self._executions += 1
        if time.monotonic() - self._written > 2.0:
            self.write()

    def add(self, finding: str, data: bytes) -> None:
        kind = finding if finding.startswith("late") else finding[:160]
        key = "".join(c for c in kind.rpartition(": ")[0] or kind if not c.isdigit())
        if key not in self.found:
            name = "found-" + hashlib.sha256(data).hexdigest()[:12]
            (self._out / name).write_bytes(data)
            self.found[key] = f"{name} {finding[:400]}"
            print(f"FOUND {name}: {finding}", flush=True)
            self.write()

    def write(self) -> None:
        self._written = time.monotonic()
        minutes = (time.process_time() - self._cpu) / 60.0
        content = {
            "executions": self._before["executions"] + self._executions,
            "cpu_minutes": round(self._before["cpu_minutes"] + minutes, 2),
            "found": self.found,
        }
        self._path.write_text(json.dumps(content, indent=1))
        if self._written - self._said > SAY_EVERY_S:
            self._said = self._written
            print(
                f"{self._executions} executions in {self._said - self._began:.0f} s,"
                f" {len(self.found)} findings", flush=True,
            )  # fmt: skip


def run(reader: str, out: Path, seconds: float, seed: int, guided: bool) -> None:
    """Read damaged files until the time is over. An input is the number of a part and its bytes."""
    if guided:
        import atheris

        _import_all(*BELOW)
        with atheris.instrument_imports(include=["pcfix.io"], exclude=list(KERNELS)):
            _import_all("io")
        for name in KERNELS:
            _instrument_functions(importlib.import_module(name), atheris)
    from tests.fuzz.judge import Bench, Finding
    from tests.fuzz.mutations import mutated

    log = Log(out)
    with tempfile.TemporaryDirectory(dir=_fast()) as folder:
        bench = Bench(reader, Path(folder))

        def read(data: bytes) -> None:
            log.count()
            part = bench.parts[int.from_bytes(data[:2], "little") % len(bench.parts)]
            try:
                bench.read(part, data[2:])
            except Finding as finding:
                log.add(str(finding), data)

        def change(data: bytes, most: int, number: int) -> bytes:
            chance = random.Random(number)
            if chance.random() < 0.4:
                return atheris.Mutate(data, most)
            if chance.random() < 0.05:
                data = chance.randrange(len(bench.parts)).to_bytes(2, "little") + data[2:]
            return data[:2] + mutated(data[2:], chance)[: most - 2]

        if not guided:
            _at_random(bench, read, mutated, seconds, seed)
            log.write()
            return
        corpus = out / "corpus"
        corpus.mkdir(exist_ok=True)
        most = 20_000 + 3 * max(len(part.data) for part in bench.parts) // 2
        for i, part in enumerate(bench.parts):
            (corpus / f"seed-{i}").write_bytes(i.to_bytes(2, "little") + part.data)
        atheris.Setup(
            ["fuzz", str(corpus), f"-max_total_time={seconds:.0f}", f"-seed={seed}",
             f"-max_len={most}", "-rss_limit_mb=6000", "-timeout=120", f"-artifact_prefix={out}/",
             "-print_final_stats=1", "-report_slow_units=30"],
            read, custom_mutator=change,
        )  # fmt: skip
        atheris.Fuzz()


def _at_random(bench: Any, read: Any, mutated: Any, seconds: float, seed: int) -> None:
    chance, ends = random.Random(seed), time.monotonic() + seconds
    while time.monotonic() < ends:
        at = chance.randrange(len(bench.parts))
        read(at.to_bytes(2, "little") + mutated(bench.parts[at].data, chance))


def _import_all(*rooms: str) -> None:
    folder = Path(pcfix.__file__).parent
    for path in sorted(one for room in rooms for one in (folder / room).rglob("*.py")):
        parts = path.relative_to(folder.parent).with_suffix("").parts
        name = ".".join(parts).removesuffix(".__init__")
        if name not in KERNELS:
            importlib.import_module(name)


def _instrument_functions(module: ModuleType, atheris: Any) -> None:
    """Count what the functions of a module do, but for those that are compiled."""
    held = [vars(one) for one in vars(module).values() if inspect.isclass(one)]
    for one in [function for names in (vars(module), *held) for function in names.values()]:
        if inspect.isfunction(one) and one.__module__ == module.__name__:
            atheris.instrument_func(one)


def _fast() -> str | None:
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def replay(reader: str, out: Path) -> None:
    """Read the whole corpus again, and count the lines of the reader that this reaches."""
    import coverage

    counter = coverage.Coverage(source=["pcfix"], data_file=None, messages=False)
    counter.start()
    from tests.fuzz.judge import Bench, Finding
    from tests.fuzz.mutations import mutated

    inputs = sorted((out / "corpus").glob("*")) if (out / "corpus").is_dir() else []
    still = 0
    with tempfile.TemporaryDirectory(dir=_fast()) as folder:
        bench = Bench(reader, Path(folder))
        datas = [one.read_bytes() for one in (*inputs, *sorted(out.glob("found-*")))]
        if not inputs:
            chance = random.Random(1)
            at = [chance.randrange(len(bench.parts)) for _ in range(3000)]
            datas += [i.to_bytes(2, "little") + mutated(bench.parts[i].data, chance) for i in at]
        for data in datas:
            part = bench.parts[int.from_bytes(data[:2], "little") % len(bench.parts)]
            try:
                bench.read(part, data[2:])
            except Finding:
                still += 1
        modules = bench.reader.modules
    counter.stop()
    lines, missed = 0, 0
    for path in sorted(counter.get_data().measured_files()):
        name = ".".join(Path(path).with_suffix("").parts).partition("pcfix.")[2]
        if (
            any(f"pcfix.{name}.".startswith(f"{module}.") for module in modules)
            and name[-7:] != "writing"
        ):
            _, statements, _, absent, _ = counter.analysis2(path)
            lines, missed = lines + len(statements), missed + len(absent)
            print(f"  {name}: {1 - len(absent) / max(1, len(statements)):.0%}, not {absent}")
    known = json.loads((out / "found.json").read_text()) if (out / "found.json").exists() else {}
    print(
        f"{reader}: {known.get('executions', 0):,} executions, {known.get('cpu_minutes', 0):.1f}"
        f" minutes of CPU, {1 - missed / max(1, lines):.1%} of {lines} lines reached by"
        f" {len(datas)} inputs, {len(known.get('found', {}))} findings, {still} inputs still fail"
    )


def again(reader: str, path: Path) -> None:
    """Read one input, and show what happens."""
    from tests.fuzz.judge import Bench

    data = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(reader, Path(folder))
        part = bench.parts[int.from_bytes(data[:2], "little") % len(bench.parts)]
        print(f"{part.seed}: {part.path.name} {part.entry}: {data[2:1000]!r}")
        print(bench.read(part, data[2:]))


if __name__ == "__main__":
    main()
