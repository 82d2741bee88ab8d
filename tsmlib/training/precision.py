"""Whether matrix products in bfloat16 pay on a processor.

Where it has no instructions for them, torch emulates them: on AVX2 alone a training takes six to ten times as long as
in float32.
"""

from __future__ import annotations

import os
import platform

import torch

# Values of oneDNN's variable that hold it to instructions without such products.
WITHOUT = ("SSE41", "AVX", "AVX2", "AVX2_VNNI", "AVX2_VNNI_2", "AVX512_CORE", "AVX512_CORE_VNNI")


def native_bf16(device: str | torch.device = "cpu") -> bool:
    """Whether the processor of ``device`` multiplies matrices in bfloat16 by instructions of its own.

    False also where ATEN_CPU_CAPABILITY or ONEDNN_MAX_CPU_ISA in the environment keeps torch from using them.
    """
    device = torch.device(device)
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type != "cpu" or not torch.backends.mkldnn.is_available():
        return False
    if (
        not torch.ops.mkldnn._is_mkldnn_bf16_supported()
    ):  # also true of processors with AVX-512, where it is emulated
        return False
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return True
    held = os.environ.get("ONEDNN_MAX_CPU_ISA") or os.environ.get("DNNL_MAX_CPU_ISA") or ""
    return (
        torch.cpu._is_avx512_bf16_supported()
        and torch.backends.cpu.get_cpu_capability() not in ("NO AVX", "DEFAULT", "AVX2")
        and held.upper() not in WITHOUT
    )
