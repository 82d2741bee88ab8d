"""Commands of the reproduction: ``python -m tsmlib`` hands these on.

``run NOTEBOOK`` executes a notebook, ``run all`` all of them in order; ``control`` is short for
``run control``, and so on. ``explore`` serves the explorer, ``test`` runs the tests of a checkout.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from reproduction import explorer, runner
from reproduction.runs import SCALES, Run, home
from tsmlib.shipped import ROOT


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: the words after ``python -m tsmlib``; the command line's where it is None.

    Returns:
        0 done, 1 it failed, 2 bad arguments, 130 interrupted.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in runner.notebooks().keys() - {
        "claims",
        "explore",
    }:  # these two are more
        words.insert(0, "run")
    try:
        if words[:1] == ["test"]:
            return _test(words[1:])
        arguments = _parser().parse_args(words)
        return arguments.do(arguments)
    except (RuntimeError, ValueError, TypeError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2 if isinstance(error, ValueError | TypeError) else 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tsmlib", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="execute a notebook into runs/<scale>/seed<seed>/")
    run.add_argument(
        "notebook", help=f"{', '.join(runner.notebooks())}, all, or the path of a copy"
    )
    run.add_argument("--scale", default="laptop", help="laptop, paper, or smoke, which is a test")
    run.add_argument("--seed", type=int, default=0)
    run.add_argument(
        "-p",
        dest="given",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="another parameter of the notebook",
    )
    run.add_argument("--missing", action="store_true", help="only those not executed as they are")
    run.set_defaults(do=_run)
    make = commands.add_parser("make", help="make targets, and what they are made from")
    make.add_argument("targets", nargs="+", help="such as models/Reacher/tsm, tables/03_predict")
    make.add_argument("--scale", default="laptop", help=", ".join(SCALES))
    make.add_argument("--seed", type=int, default=0)
    make.add_argument("--again", action="store_true", help="although they are there")
    make.set_defaults(do=_make)
    pool = commands.add_parser("pool", help="join a table of several seeds")
    pool.add_argument("table", help="such as 03_predict")
    pool.add_argument("--scale", default="paper", help=", ".join(SCALES))
    pool.add_argument("--seeds", nargs="+", type=int, required=True)
    pool.set_defaults(do=_pool)
    claims = commands.add_parser("claims", help="judge the claims, write docs/claims.md")
    claims.set_defaults(do=_claims)
    pages = commands.add_parser("pages", help="fill marked tables of pages, draw figures again")
    pages.add_argument("pages", nargs="*", type=Path, help="default: docs/results.md")
    pages.add_argument("--figures", type=Path, help="a folder for the figures of the tables")
    pages.set_defaults(do=_pages)
    explore = commands.add_parser("explore", help="serve the explorer, a page, on 127.0.0.1")
    explore.add_argument("--port", type=int, default=explorer.PORT, help="0 is any that is free")
    explore.add_argument("--open", action="store_true", help="open it in a browser")
    explore.set_defaults(do=_explore)
    commands.add_parser("test", help="run the tests of a checkout; options are those of pytest")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    texts = dict[str, str]()
    for item in arguments.given:
        name, equals, text = item.partition("=")
        if not equals or name in ("scale", "seed"):
            raise ValueError(f"-p {item!r:.80}: expected NAME=VALUE; --scale and --seed for these")
        texts[name] = text
    run = Run(arguments.scale, arguments.seed)
    runner.require_tools()
    word = arguments.notebook
    paths = list(runner.notebooks().values()) if word == "all" else [runner.find(word)]
    if run.scale == "smoke":
        print(
            "scale smoke is a test that a notebook runs; its numbers say nothing", file=sys.stderr
        )
    for path, values in [(path, runner.typed(path, texts)) for path in paths]:
        if arguments.missing and runner.is_executed(path, run.folder / path.name):
            continue
        copy = runner.execute(path, run, values)
        print(f"Executed, with its pictures: {_linked(copy)}")
        for film in sorted(copy.parent.glob(f"{path.stem[:2]}_*.mp4")):
            print(f"Film: {_linked(film)}")
    return 0


def _linked(path: Path) -> str:
    """A path, which a terminal shows as a link where it can."""
    if not sys.stdout.isatty():
        return str(path)
    return f"\033]8;;{path.as_uri()}\033\\{path}\033]8;;\033\\"


def _make(arguments: argparse.Namespace) -> int:
    from reproduction import targets  # heavy

    run = Run(arguments.scale, arguments.seed)
    for name in arguments.targets:
        print(targets.make(run, name, again=arguments.again))
    return 0


def _pool(arguments: argparse.Namespace) -> int:
    from reproduction import targets

    print(targets.pool(arguments.scale, arguments.table, arguments.seeds))
    return 0


def _claims(arguments: argparse.Namespace) -> int:
    from reproduction.claims import ledger

    print(*ledger.write(home() / "docs"), sep="\n")
    return 0


def _pages(arguments: argparse.Namespace) -> int:
    from reproduction import figures, pages
    from tsmlib import plots

    for page in arguments.pages or [home() / "docs" / "results.md"]:
        print(pages.fill(page))
    for name, draw in figures.FIGURES.items() if arguments.figures else ():
        print(plots.save(draw(), arguments.figures / f"{name}.png"))
    return 0


def _explore(arguments: argparse.Namespace) -> int:
    explorer.serve(port=arguments.port, browser=arguments.open)
    return 0


def _test(words: Sequence[str]) -> int:
    if not (ROOT / "tests").is_dir():
        raise runner.RunError(
            f"there are no tests in {ROOT}: they come with a checkout (git clone)"
        )
    command = [sys.executable, "-m", "pytest", "-n", "2", "--dist", "loadfile"]
    command += ["--no-loadscope-reorder", *(words or ["tests"])]
    return subprocess.call(command, cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": "1"})


if __name__ == "__main__":
    sys.exit(main())
