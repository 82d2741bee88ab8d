"""PushT beside ``gym-pusht``, number by number: the same starts and actions, every state compared.

python benchmarks/peers/pusht.py write episodes.npz        here
python benchmarks/peers/pusht.py compare episodes.npz      with gym-pusht 0.1.8 (pymunk < 7)
"""

import sys

import numpy as np


def write(path: str, episodes: int = 60, steps: int = 50) -> None:
    """Random play of our own environment."""
    from tsmlib.envs.pusht import PushT

    env, rng = PushT(episodes), np.random.default_rng(0)
    states, actions = [env.reset(seed=77)[0]], []
    for _ in range(steps):
        pusher, tee = states[-1][:, :2], states[-1][:, 2:4]
        target = pusher + 100 * rng.uniform(-1, 1, pusher.shape)
        target = np.clip(target, tee - 100, tee + 100)
        actions.append(np.clip((target - pusher) / 100, -1, 1))
        states.append(env.rollout(actions[-1][:, None])[:, 0])
    np.savez(path, states=np.stack(states, 1), actions=np.stack(actions, 1))


def compare(path: str) -> None:
    """The same episodes in gym-pusht, whose actions are places."""
    from gym_pusht.envs.pusht import PushTEnv

    data, env, worst = np.load(path), PushTEnv(obs_type="state"), 0.0
    for states, actions in zip(data["states"], data["actions"], strict=True):
        env.reset(seed=0)
        env._setup()  # a space without contacts
        x, y, tee_x, tee_y, angle, *velocity = states[0].tolist()
        env.agent.position, env.agent.velocity = (x, y), tuple(velocity)
        env.block.angle = angle
        env.block.position = (tee_x, tee_y)
        for action, expected in zip(actions, states[1:], strict=True):
            env.step(np.array(env.agent.position) + 100 * action)
            pusher, tee = env.agent, env.block
            state = [*pusher.position, *tee.position, tee.angle, *pusher.velocity]
            worst = max(worst, float(np.abs(np.array(state) - expected).max()))
    print(f"largest difference in {len(data['states'])} episodes: {worst}")


if __name__ == "__main__":
    {"write": write, "compare": compare}[sys.argv[1]](sys.argv[2])
