"""bfloat16 is for processors that multiply it; what was used is recorded."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from test_train import new_tsm, same, train, weights

from tsmlib import study
from reproduction import runs
from tsmlib.training.precision import native_bf16


def processor(
    monkeypatch: pytest.MonkeyPatch, *, oneDNN: bool, bf16: bool, capability: str = "AVX512"
) -> None:
    """An imitation: what oneDNN says it can do, what the processor has, and what torch's own loops use."""
    for name in ("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(torch.backends.mkldnn, "is_available", lambda: True)
    monkeypatch.setattr(
        torch.ops.mkldnn, "_is_mkldnn_bf16_supported", lambda: oneDNN, raising=False
    )
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: bf16)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)


def test_it_is_native_only_where_the_processor_has_the_instruction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    processor(monkeypatch, oneDNN=True, bf16=True)
    assert native_bf16()
    processor(
        monkeypatch, oneDNN=True, bf16=False
    )  # AVX-512 of before bfloat16, where oneDNN emulates it
    assert not native_bf16()
    processor(monkeypatch, oneDNN=False, bf16=False, capability="AVX2")
    assert not native_bf16()
    processor(monkeypatch, oneDNN=True, bf16=False)
    monkeypatch.setattr(
        platform, "machine", lambda: "aarch64"
    )  # where oneDNN asks the processor itself
    assert native_bf16()
    assert not native_bf16("meta")


def test_the_environment_may_keep_it_from_being_used(monkeypatch: pytest.MonkeyPatch) -> None:
    processor(monkeypatch, oneDNN=True, bf16=True)
    for value, native in {
        "AVX2": False,
        "avx512_core": False,
        "AVX512_CORE_BF16": True,
        "DEFAULT": True,
    }.items():
        monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", value)
        assert native_bf16() == native, value
    processor(
        monkeypatch, oneDNN=True, bf16=True, capability="AVX2"
    )  # by ATEN_CPU_CAPABILITY, below
    assert not native_bf16()


@pytest.mark.skipif(platform.machine() != "x86_64", reason="variables of x86")
def test_torch_reads_the_variable_that_the_benchmark_holds_it_by() -> None:
    code = (
        "import torch; from tsmlib.training.precision import native_bf16; "
        "print(torch.backends.cpu.get_cpu_capability(), native_bf16())"
    )
    for value, held in {"default": "DEFAULT False", "avx2": "AVX2 False"}.items():
        env = {**os.environ, "ATEN_CPU_CAPABILITY": value}
        found = subprocess.run(
            [sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True
        ).stdout
        assert found.strip() in (
            held,
            "DEFAULT False",
        )  # also a processor with less than was asked for


def native(monkeypatch: pytest.MonkeyPatch, value: bool) -> None:
    for module in ("fit", "checkpoint"):
        monkeypatch.setattr(f"tsmlib.training.{module}.native_bf16", lambda device: value)


def test_training_is_in_bfloat16_where_it_is_asked_for_and_native(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = {}
    for asked in (False, True):
        for there in (False, True):
            native(monkeypatch, there)
            model = new_tsm()
            curve = train(model, bf16=asked)
            assert curve.bf16 == [asked and there] * 4
            found[asked, there] = weights(model)
    assert same(found[True, False], found[False, False])
    assert same(found[False, True], found[False, False])
    assert not same(found[True, True], found[False, False])


def test_a_training_goes_on_where_it_is_not_native_and_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    native(monkeypatch, True)
    model = new_tsm()

    def until(window: object, generator: torch.Generator) -> torch.Tensor:
        if len(list((tmp_path / "run").glob("*.safetensors"))) == 2 and torch.is_grad_enabled():
            raise KeyboardInterrupt
        return model.loss(window, generator)

    until.__name__ = "loss"
    with pytest.raises(KeyboardInterrupt):
        train(model, until, bf16=True, checkpoint=tmp_path / "run")
    native(monkeypatch, False)
    with pytest.warns(UserWarning, match="native_bf16 True -> False.*may differ in its last bits"):
        curve = train(new_tsm(), bf16=True, checkpoint=tmp_path / "run")
    assert curve.bf16 == [True, True, False, False]
    assert "at step 10: native_bf16 True -> False" in curve.resumed


@pytest.mark.parametrize("there", [False, True])
def test_a_model_says_which_stages_were_in_bfloat16(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, there: bool
) -> None:
    native(monkeypatch, there)
    monkeypatch.setattr(
        "reproduction.models.dataset", lambda run, env, split: study.random_data(env, 4, seed=0)
    )
    run = runs.resolve("02_train", scale="smoke", run_dir=str(tmp_path))
    monkeypatch.setattr("reproduction.models._inputs", lambda *_: {})
    header = study.load_or_train(run, "tsm/Reacher-v0", "onestep").header
    assert header["bf16"] == (["loss"] if there else [])
    assert (
        study.load_or_train(run, "tsm/Reacher-v0", "onestep").header["bf16"] == header["bf16"]
    )  # as it was made
