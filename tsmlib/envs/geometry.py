"""Constants, state layout and kinematics that both simulators share.

State (float64, all in one horizontal plane):

    joint angles (2, rad, not wrapped), joint velocities (2, rad/s), fingertip (2, m) and with a
    block: its position (2, m) and velocity (2, m/s; zero for the obstacle, which never moves)
"""

import numpy as np

from tsmlib.envs.physics import Physics
from tsmlib.envs.spec import EnvSpec

# The arm is Gymnasium's Reacher; a test compares these lengths with its model (m). What can differ
# in a variant is that of the standard arm here; ``EnvSpec.parse(env_id).physics`` knows it of every
# arm.
LINK_LENGTHS = Physics.link_lengths  # shoulder to elbow, elbow to centre of the fingertip
LINK1_CAPSULE = 0.1  # the second link's capsule ends before the fingertip's sphere begins
ARM_RADIUS = 0.01  # links and fingertip alike
ELBOW_LIMIT = 3.0  # rad; the shoulder turns freely
GEAR = 200.0  # N m per unit of action
DT = 0.02  # s per step

# The block: the object to push, or the obstacle (a disc seen from above).
BLOCK_RADIUS = Physics.object_radius
WALL = 0.24  # the walls' faces on push; the object's centre stays within 0.21 m along x and y
# kg, comparable to the arm's inertia (1 kg m^2), which keeps penetration small
BLOCK_MASS = Physics.mass
BLOCK_DECAY = 0.05  # s; a free object slows down by a factor e in this time
RESTITUTION = 0.4  # share of the normal speed kept at a wall (the arm's contact is dead)
FRICTION = 0.0  # the arm is so strong that friction would wedge it against the obstacle
# m; distance of the block's centre from the shoulder at reset: within reach all around
BLOCK_RING = (0.08, 0.17)
BLOCK_CLEARANCE = 0.005  # m between block and arm at reset
MAX_OVERLAP = 0.005  # m of block and arm in a given start; impacts reach 1.5 mm

START_VELOCITY = 0.005  # rad/s, both joints
START_ANGLES = {  # rad; shoulder and elbow are uniform within plus and minus this
    "reach": (0.1, 0.1),
    "obstacle": (0.1, 0.1),  # the reset distribution of Gymnasium's Reacher
    "push": (np.pi, 2.5),  # in every direction, and bent
}
TARGET_RING = {  # m from the shoulder, uniform over the area; nearer, link 1 is in the way
    "reach": (0.0, 0.2),
    "obstacle": (0.0, 0.2),
    "push": (0.05, 0.2),
}

STATE_NAMES = (
    "joint0",
    "joint1",
    "joint0_vel",
    "joint1_vel",
    "tip_x",
    "tip_y",
    "block_x",
    "block_y",
    "block_vx",
    "block_vy",
)
STATE_UNITS = ("rad", "rad", "rad/s", "rad/s", "m", "m", "m", "m", "m/s", "m/s")
# In random data; angles: of cosine, sine.
HALF_RANGE = (1.0, 1.0, 17.0, 14.0, 0.21, 0.21, 0.21, 0.21, 4.8, 4.6)


def arm_points(
    angles: np.ndarray, lengths: tuple[float, float] = LINK_LENGTHS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forward kinematics: angles (..., 2) to elbow, end of the second capsule, and fingertip (each
    (..., 2), m).
    """
    shoulder, reach = angles[..., 0], angles[..., 0] + angles[..., 1]
    elbow = lengths[0] * np.stack([np.cos(shoulder), np.sin(shoulder)], axis=-1)
    direction = np.stack([np.cos(reach), np.sin(reach)], axis=-1)
    return elbow, elbow + capsule_length(lengths) * direction, elbow + lengths[1] * direction


def capsule_length(lengths: tuple[float, float]) -> float:
    """Length of the second link's capsule, m."""
    return LINK1_CAPSULE if lengths == LINK_LENGTHS else lengths[1] - ARM_RADIUS


def fingertip(angles: np.ndarray, lengths: tuple[float, float] = LINK_LENGTHS) -> np.ndarray:
    """Fingertip position (..., 2) of joint angles (..., 2)."""
    return arm_points(angles, lengths)[2]


def slide_time(physics: Physics) -> float:
    """Seconds in which a free object slows down by a factor e: its mass over its drag."""
    return BLOCK_DECAY * physics.mass / BLOCK_MASS


def room(physics: Physics) -> float:
    """Largest coordinate of the object's centre along x and y, between the walls, m."""
    return WALL - physics.object_radius


def target_ring(spec: EnvSpec) -> tuple[float, float]:
    """Radii between which targets are drawn, m: those of the task, as far as this arm and its
    object can get.
    """
    inner, outer = TARGET_RING[spec.task]
    inner, reach = max(inner, hole(spec.physics)), sum(spec.physics.link_lengths)
    return inner, min(outer, reach, room(spec.physics)) if spec.task == "push" else min(
        outer, reach
    )


def hole(physics: Physics) -> float:
    """Radius around the shoulder within which the fingertip has no target, m: of where it does not
    get, less 1 cm.

    The standard arm's 1 cm are part of its task.
    """
    near, far = sorted(physics.link_lengths)
    return max(0.0, far - near - 0.01)


def block_ring(spec: EnvSpec) -> tuple[float, float]:
    """Radii between which obstacle or object are at reset, m."""
    inner, outer = BLOCK_RING
    return inner, min(outer, sum(spec.physics.link_lengths))


def closest_gap(states: np.ndarray, env_id: str) -> np.ndarray:
    """Signed distance (...) between the arm's surface and the block's, in metres, of states (...,
    10).

    Negative where they penetrate. The same geometry for both simulators. ValueError where there is
    no block.
    """
    spec = EnvSpec.parse(env_id)
    if not spec.has_block:
        raise ValueError(
            f"{env_id} has no block; closest_gap needs an obstacle or push environment"
        )
    states = np.asarray(states, np.float64)
    block = states[..., 6:8]
    elbow, capsule_end, tip = arm_points(states[..., :2], spec.physics.link_lengths)
    distance = np.minimum(
        np.minimum(
            _to_segment(block, np.zeros_like(elbow), elbow), _to_segment(block, elbow, capsule_end)
        ),
        np.linalg.norm(block - tip, axis=-1),
    )
    return distance - (ARM_RADIUS + spec.physics.object_radius)


def _to_segment(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    share = np.sum((point - start) * along, axis=-1) / np.sum(along * along, axis=-1)
    return np.linalg.norm(point - start - np.clip(share, 0.0, 1.0)[..., None] * along, axis=-1)
