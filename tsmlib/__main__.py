"""Command line: run, notebooks, explore, verify, bench and publish; ``tsmlib`` and ``python -m tsmlib`` are the same.

``python -m tsmlib run NOTEBOOK`` executes a notebook, ``run NOTEBOOK --help`` lists its parameters.
``python -m tsmlib run all --seeds 0-9`` executes all for ten seeds, here or (``--executor``) on a cluster.
``python -m tsmlib notebooks FOLDER`` copies the notebooks out, to be opened, changed and run by their paths.
``python -m tsmlib explore`` serves the explorer, a page in the browser, to this machine.
``python -m tsmlib verify [PATH]`` hashes again.
``python -m tsmlib bench [NAME]`` measures speed; ``bench table`` writes docs/speed.md from what was measured.
``python -m tsmlib publish`` copies a paper-scale run to what ships.

Exit status: 0 done, 1 a notebook failed or an artefact is damaged, 2 bad arguments, 130 interrupted.
"""

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import tsmlib
from tsmlib.storage import files
from reproduction import notebooks, parameters, runs


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="tsmlib", description="Temporal segment models.")
    parser.add_argument("--version", action="version", version=f"tsmlib {tsmlib.__version__}")
    commands = parser.add_subparsers(dest="command", required=True)
    names = ", ".join(runs.notebooks())
    run = commands.add_parser(
        "run",
        help="execute a notebook into runs/<scale>/seed<k>/",
        add_help=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    run.add_argument("notebook", nargs="?", default="", help=f"{names}, all, or the path of a copy")
    run.add_argument(
        "-h",
        "--help",
        action="store_true",
        help="show this, and the parameters of NOTEBOOK, and end",
    )
    run.add_argument("--scale", default="", help="smoke, laptop (default) or paper")
    run.add_argument("--seed", help="0 .. 2147483647 (default 0)")
    run.add_argument(
        "--device",
        default="",
        help="where to train, learn, plan and roll out: cpu (default) or cuda",
    )
    run.add_argument(
        "-p",
        dest="given",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="a notebook parameter",
    )
    flow = run.add_argument_group(
        "several seeds, as a workflow (docs/howto/cluster.md); options of Snakemake follow --"
    )
    flow.add_argument(
        "--seeds",
        help="such as 0-9 or 0,2,5: a job for each model, policy (on a GPU one for all seeds), score, plan, notebook",
    )
    flow.add_argument(
        "--executor",
        default="",
        help="local, slurm or another plugin of Snakemake's; pool: without it",
    )
    flow.add_argument(
        "--jobs",
        type=int,
        default=0,
        help="at a time (default: TSM_JOBS, else one for each core; elsewhere 100)",
    )
    flow.add_argument("--dry-run", action="store_true", help="list the jobs, and do nothing")
    flow.add_argument(
        "--any-code", action="store_true", help="go on with what another version of tsmlib has made"
    )
    step = commands.add_parser(
        "step", help="one job of a workflow: what `run --seeds` executes in each of its processes"
    )
    step.add_argument("notebook")
    step.add_argument(
        "--job",
        default="",
        help="what the notebook needs, by its name; default: the notebook itself",
    )
    for option in ("--scale", "--seed", "--device"):
        step.add_argument(option, default=None if option == "--seed" else "")
    step.add_argument("--seeds", help="of a model or policy that is made with several as one")
    step.add_argument("-p", dest="given", metavar="NAME=VALUE", action="append", default=[])
    copy = commands.add_parser("notebooks", help="copy the notebooks into a folder")
    copy.add_argument("folder", type=Path)
    explore = commands.add_parser(
        "explore", help="serve the explorer, a page in the browser, on 127.0.0.1"
    )
    explore.add_argument(
        "--port", type=int, default=8765, help="default 8765; 0 is any that is free"
    )
    explore.add_argument("--open", action="store_true", help="open it in a browser")
    verify = commands.add_parser(
        "verify", help="hash an artefact, a run, or everything that ships, again"
    )
    verify.add_argument(
        "path", type=Path, nargs="?", default=runs.ROOT / "data", help="default: what ships"
    )
    bench = commands.add_parser("bench", help="measure speed, against a reference in the same run")
    bench.add_argument(
        "name",
        nargs="?",
        default="all",
        help=f"{', '.join(_benchmarks())}, all (default), or table",
    )
    publish = commands.add_parser(
        "publish", help="copy a paper-scale run into data/, figures/ and README"
    )
    publish.add_argument("--seed", default="0")
    publish.add_argument(
        "--claims",
        action="store_true",
        help="only judge the claims again, from the tables that ship",
    )
    publish.add_argument(
        "--figures", action="store_true", help="only draw the figures again of what ships"
    )
    publish.add_argument(
        "--table", default="", help="only the table of this notebook, for example your_own"
    )
    words = list(sys.argv[1:] if argv is None else argv)
    end = words.index("--") if "--" in words else len(words)
    arguments = parser.parse_args(words[:end])
    try:
        if words[end + 1 :] and arguments.command != "run":
            raise parameters.ParameterError("only run takes options of Snakemake after --.")
        match arguments.command:
            case "run" if arguments.help:
                return _help(run, arguments.notebook)
            case "notebooks":
                return _copy_notebooks(arguments.folder)
            case "explore":
                return _explore(arguments.port, browser=arguments.open)
            case "verify":
                return _verify(arguments.path)
            case "bench":
                return _bench(arguments.name)
            case "publish":
                return _publish(
                    arguments.seed,
                    claims=arguments.claims,
                    again=arguments.figures,
                    table=arguments.table,
                )
            case "step":
                return _step(arguments)
            case _:
                return _run(arguments, words[end + 1 :])
    except parameters.ParameterError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (runs.RunError, ValueError) as error:  # ValueError: StoreError
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _chosen(word: str) -> list[runs.Notebook]:
    """The notebooks that a word names: one that ships, all of these, or by its path a copy that was changed."""
    present, path = runs.notebooks(), Path(word)
    if path.suffix == ".ipynb" and path.is_file():
        return [runs.Notebook(path.stem, path.resolve())]
    if word != "all" and word not in present:
        what = f"no notebook is called {word!r:.80}; there are" if word else "name a notebook:"
        raise parameters.ParameterError(f"{what} {', '.join(present) or 'none'}, or all.")
    return list(present.values()) if word == "all" else [present[word]]


def _help(run: argparse.ArgumentParser, word: str) -> int:
    """The usage of ``run``, and every parameter of the notebooks that ``word`` names."""
    run.epilog = "\n\n".join(
        f"parameters of {notebook.name}, at their defaults:\n{parameters.explained(notebook.path)}"
        for notebook in (_chosen(word) if word else [])
    )
    run.print_help()
    return 0


def _copy_notebooks(folder: Path) -> int:
    """Copy the notebooks that ship. Refused, before anything is written, where one would replace a changed one."""
    there = {
        folder / notebook.path.name: notebook.path.read_bytes()
        for notebook in runs.notebooks().values()
    }
    if changed := [
        path.name for path, data in there.items() if path.exists() and path.read_bytes() != data
    ]:
        raise runs.RunError(
            f"{folder} holds {', '.join(changed)}, changed since or of another version. Name another folder, or move "
            "or delete what is there."
        )
    for path, data in there.items():
        if not path.exists():
            files.write_bytes(path, data)
        print(path)
    return 0


def _given(arguments: argparse.Namespace) -> dict[str, str]:
    """Parameter -> text, as typed."""
    given: dict[str, str] = {}
    for item in arguments.given:
        name, equals, text = item.partition("=")
        if not equals or name in given or name in ("scale", "seed"):
            raise parameters.ParameterError(
                f"-p {item!r:.80}: expected NAME=VALUE, each name once, and --scale and --seed for these two."
            )
        given[name] = text
    return given


def _run(arguments: argparse.Namespace, more: Sequence[str]) -> int:
    chosen, given = _chosen(arguments.notebook), _given(arguments)
    notebooks.require_tools()
    scale, device = arguments.scale, arguments.device
    options = (arguments.executor, arguments.dry_run, arguments.jobs, arguments.any_code, more)
    if arguments.seeds is not None or any(options):
        from reproduction import workflow

        prepared = workflow.prepare(
            chosen,
            _seeds(arguments),
            scale=scale,
            device=device,
            given=given,
            executor=arguments.executor,
        )
        return workflow.run_all(
            prepared,
            given,
            executor=arguments.executor,
            jobs=arguments.jobs,
            dry_run=arguments.dry_run,
            any_code=arguments.any_code,
            more=more,
        )
    seed = cast(int, parameters.convert("seed", _seed(arguments)))
    executions = [
        notebooks.prepare(one, scale=scale, seed=seed, device=device, given=given) for one in chosen
    ]
    from reproduction.data import require_other_seed  # heavy, and not needed to refuse a parameter

    require_other_seed(seed)
    if said := notebooks.other_code(executions[0].run):
        print(said, file=sys.stderr)
    for execution in executions:  # all of them are checked before the first one starts
        print(notebooks.execute(execution))
    return 0


def _seed(arguments: argparse.Namespace) -> str:
    """One seed, as typed."""
    return "0" if arguments.seed is None else str(arguments.seed)


def _seeds(arguments: argparse.Namespace) -> list[int]:
    """The seeds of a workflow; ParameterError where none is named, as by a shell variable that is not set."""
    if arguments.seeds is None:
        return parameters.parse_seeds(_seed(arguments))
    if arguments.seed is not None:
        raise parameters.ParameterError(
            f"--seed {arguments.seed} and --seeds {arguments.seeds} are both given; name all seeds with --seeds."
        )
    return parameters.parse_seeds(arguments.seeds)


def _step(arguments: argparse.Namespace) -> int:
    from reproduction import workflow

    chosen, given = _chosen(arguments.notebook), _given(arguments)
    if len(chosen) > 1:
        raise parameters.ParameterError("a step is of one notebook; name it in place of all.")
    prepared = workflow.prepare(
        chosen, _seeds(arguments), scale=arguments.scale, device=arguments.device, given=given
    )
    workflow.step(prepared, arguments.job)
    return 0


def _explore(port: int, *, browser: bool) -> int:
    from reproduction import explorer

    _require_checkout("explore")
    explorer.serve(port=port, browser=browser)
    return 0


def _verify(path: Path) -> int:
    from tsmlib.storage import manifest

    files = manifest.verify(path)
    for file in files:
        print(f"ok  {file}")
    print(f"{len(files)} files are as they were made")
    return 0


def _publish(seed: str, *, claims: bool, again: bool, table: str) -> int:
    from reproduction import publish

    _require_checkout("publish")
    if claims:
        publish.publish_claims()
        return 0
    if again:
        left = ", ".join(path.name for path in publish.publish_figures())
        print(f"as they were, since they need a run at scale paper, or a benchmark: {left}")
        return 0
    run = runs.resolve("publish", scale="paper", seed=parameters.convert("seed", seed))  # type: ignore[arg-type]
    if table:
        pooled = {
            name: each.stem
            for name, each in runs.notebooks().items()
            if each.stem in publish.POOLED
        }
        if table not in pooled:
            raise parameters.ParameterError(
                f"no table is called {table!r:.80}; there are {', '.join(pooled)}."
            )
        publish.publish_table(run, pooled[table])
        return 0
    publish.publish(run)
    return 0


def _require_checkout(command: str) -> None:
    if runs.INSTALLED:
        raise parameters.ParameterError(
            f"{command} works on the repository; this is an installed package: clone it."
        )


def _benchmarks() -> dict[str, Path]:
    """The scripts that measure; a name that begins with _ is what they share."""
    folder = runs.ROOT / "benchmarks"
    return {
        path.stem: path for path in sorted(folder.glob("*.py")) if not path.stem.startswith("_")
    }


def _bench(name: str) -> int:
    _require_checkout("bench")
    present, table = _benchmarks(), runs.ROOT / "benchmarks" / "_table.py"
    if name not in ("all", "table", *present):
        raise parameters.ParameterError(
            f"no benchmark is called {name!r:.80}; there are {', '.join(present)}, all of them, or table."
        )
    scripts = [
        *(present[word] for word in present if name in ("all", word)),
        *[table] * (name in ("all", "table")),
    ]
    for script in scripts:  # in a process of its own, so that its memory is too
        options = ["--publish"] * (name == "table")
        status = subprocess.run([sys.executable, script, *options], check=False).returncode
        if status:
            word = script.stem.removeprefix("_")
            raise runs.RunError(
                f"the benchmark {word} ended with status {status}; what went wrong stands above."
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
