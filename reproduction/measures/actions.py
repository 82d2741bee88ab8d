"""Action statistics: roughness, spectrum and novelty of torques, and samples of the action prior
(section 5.3.5).

Letters in shapes: B plans or episodes, T steps, F frequencies, q traits.
"""

import torch
from torch import Tensor

from tsmlib.envs.geometry import DT
from tsmlib.models.action_prior import ActionPrior
from tsmlib.models.layers import on_device_of

TRAITS = ("change", "centroid", "autocorrelation")  # of claim C51


def traits(actions: Tensor, *, shape: bool = False) -> Tensor:
    """TRAITS of torques (B, T, du), (B, 3). shape: of each plan divided by its own root mean
    square.
    """
    if shape:
        actions = actions / actions.square().mean((1, 2), keepdim=True).sqrt().clamp_min(1e-9)
    found = roughness(actions)
    return torch.stack([found[name] for name in TRAITS], dim=1).double()


def _power(actions: Tensor, dt: float) -> tuple[Tensor, Tensor]:
    """Frequencies (F,) in Hz and the power (B, F) of torques (B, T, du): T times what each adds to
    their squares.
    """
    steps = actions.shape[1]
    power = torch.fft.rfft(actions.double(), dim=1).abs().square().sum(-1)
    power[:, 1 : (steps + 1) // 2] *= (
        2  # all but the constant part and the highest of even T have a mirror image
    )
    return torch.fft.rfftfreq(steps, dt).double(), power


@torch.no_grad()
def sample_actions(prior: ActionPrior, n: int, horizon: int, generator: torch.Generator) -> Tensor:
    """Torques (n, horizon, du) of codes from N(0, I), from rest (U_0 = 0); on the generator's
    device.
    """
    z = torch.randn(
        n,
        -(-horizon // prior.segment_len),
        prior.latent_dim,
        generator=generator,
        device=generator.device,
    )
    return prior.plan(_rest(prior, n), *on_device_of(prior, z))[:, :horizon].to(z.device)


@torch.no_grad()
def reconstruct(prior: ActionPrior, actions: Tensor) -> Tensor:
    """Torques (B, T, du) encoded segment by segment and decoded from the mean codes, T a multiple
    of H.
    """
    home, (actions,) = actions.device, on_device_of(prior, actions)
    segments = actions.unflatten(1, (-1, prior.segment_len))  # (B, K, H, du)
    codes, _ = prior.encode(segments.flatten(0, 1))
    return prior.plan(_rest(prior, len(actions)), codes.unflatten(0, segments.shape[:2])).to(home)


def _rest(prior: ActionPrior, n: int) -> Tensor:
    return prior.std.new_zeros(n, prior.past_len, len(prior.std))


def roughness(actions: Tensor, dt: float = DT) -> dict[str, Tensor]:
    """Roughness of torques (B, T, du) (claims C12, C51, C52), one number per plan: (B,) each.

    ``change``: mean |u_{t+1} - u_t|. ``centroid``: mean frequency in Hz, weighted by power.
    ``fast``: share of power above 5 Hz. ``autocorrelation``: of successive torques. Without any
    torque all are zero.
    """
    tiny = 1e-12
    frequency, power = _power(actions, dt)
    total = power.sum(1) + tiny
    successive = (actions[:, 1:] * actions[:, :-1]).sum((1, 2))
    return {
        "change": actions.diff(dim=1).abs().mean((1, 2)),
        "centroid": ((power @ frequency) / total).float(),
        "fast": (power[:, frequency > 5].sum(1) / total).float(),
        "autocorrelation": successive / (actions.square().sum((1, 2)) + tiny),
    }


def novelty(actions: Tensor, data: Tensor, *, segment_len: int = 10) -> Tensor:
    """Distance (B,) of plans (B, T, du) from the training torques (N, T', du).

    The root mean square difference between each segment of a plan and the nearest of all segments
    of the data, in standard deviations of the data's torques, averaged over the plan. Held-out
    torques give the value to compare with.
    """
    if min(actions.shape[1], data.shape[1]) < segment_len:
        raise ValueError(
            f"plans of {actions.shape[1]} and data of {data.shape[1]} steps "
            f"hold no segment of {segment_len} steps"
        )
    std = data.flatten(0, 1).std(0)
    segments = (actions / std).unfold(1, segment_len, segment_len).flatten(2)  # (B, K, du H)
    nearest = segments.new_full(segments.shape[:2], torch.inf).flatten()
    for episodes in (data / std).split(200):
        known = episodes.unfold(1, segment_len, 1).flatten(0, 1).flatten(1)
        nearest = torch.minimum(nearest, torch.cdist(segments.flatten(0, 1), known).amin(1))
    return nearest.reshape(segments.shape[:2]).mean(1) / segments.shape[2] ** 0.5


def within(actions: Tensor, data: Tensor, *, share: float = 0.95) -> Tensor:
    """Share of the steps of plans (B, T, du) whose torques are no larger than the training data's:
    (B,) (claim C16).

    No larger means inside the box around zero that holds ``share`` of all steps of the data (N, T',
    du); its sides are as the standard deviations of the data's torques.
    """
    std = data.flatten(0, 1).std(0)
    size, known = ((torques / std).abs().amax(-1) for torques in (actions, data))
    return (size <= known.flatten().quantile(share)).float().mean(1)
