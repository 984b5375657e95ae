"""Another low-level policy, without edits: scripted, with a hand-written value function, under the same high-level policy.

The interface is small. The high-level policy needs a module from observations with ``goal`` to ``state_value``; what acts needs
only the goal that it wrote. Here the value is a model of how far legs can step, and the policy a script.
"""

import pytest
import torch
from states import make_env
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from quadhrl.policies import HighLevelConfig, HighLevelPolicy

NOMINAL = torch.tensor([[0.2134, 0.1494], [0.2135, -0.1493], [-0.2694, 0.1495], [-0.2693, -0.1492]])
PAIRS = [[0, 3], [1, 2]]


class ReachValue(nn.Module):
    """A model-based value: it falls with the square of how far a foot must reach beyond a comfortable step."""

    def forward(self, goal):
        reach = goal.unflatten(-1, (6, 2)).norm(dim=-1)
        return -2000.0 * (reach - 0.12).clamp(min=0.0).square().sum(-1, keepdim=True)


class ScriptedTrot(nn.Module):
    """Trots on the spot at 3 Hz and holds each foot over its target, as far as the residuals reach."""

    def forward(self, proprioception, goal):
        foot = proprioception[..., :12].unflatten(-1, (4, 3))[..., :2]  # from the hips
        hip = foot.new_tensor([[0.0, 0.075], [0.0, -0.075]]).repeat(2, 1)
        residual = (foot + goal[..., :8].unflatten(-1, (4, 2)) - hip) / 0.1
        residual = torch.cat([residual, torch.zeros_like(residual[..., :1])], -1).clamp(-1.0, 1.0)
        generator = foot.new_tensor([-1.0, 0.3, 1.0]).expand(*foot.shape[:-2], 3)
        return torch.cat([generator, residual.flatten(-2)], -1)


def make_policy(**settings):
    value = TensorDictModule(ReachValue(), ["goal"], ["state_value"])
    return HighLevelPolicy(value, HighLevelConfig(resolution=3, **settings))


def test_a_scripted_policy_runs_in_the_environment():
    """A trot without balance falls in the end; before, it steps after the targets that its own value function chose."""
    env = make_env(2, infill=1.0, height_range=0.0)
    actor = TensorDictModule(ScriptedTrot(), ["proprioception", "goal"], ["action"])
    with torch.no_grad():
        policy = TensorDictSequential(make_policy(start_step=20), actor)
        rollout = env.rollout(90, policy=policy, break_when_any_done=False)
    assert rollout["next", "events", "pair_hit"].any(1).all()
    ahead = (rollout["targets"][:, :, 0] - rollout["feet"].gather(2, _active(rollout))).mean(2)[..., 0]
    chosen = (rollout["pair"] >= 2)[..., 0] & (rollout["events", "step_count"] >= 20)[..., 0]
    assert ahead[chosen].median() > 0.04, "its targets lie ahead of its feet"


def _active(td):
    index = torch.tensor(PAIRS)[td["pair"][..., 0] % 2]
    return index[..., None].expand(*index.shape, 2)


class Stepper:
    """A quadruped without dynamics: feet move towards their targets by at most 2 cm a step; on arrival pairs swap."""

    def __init__(self):
        self.feet, self.footholds, self.pair, self.step = NOMINAL.clone(), NOMINAL.clone(), 2, 0
        self.position = NOMINAL.clone()

    def observe(self):
        stance = PAIRS[1 - self.pair % 2]
        vectors = torch.cat([self.position - self.feet, self.position[stance] - self.feet[stance]])
        return TensorDict(
            {
                "goal": vectors.flatten()[None],
                "yaw": torch.zeros(1, 1),
                "feet": self.feet[None],
                "footholds": self.footholds[None],
                "pair": torch.tensor([[self.pair]]),
                "events": {"step_count": torch.tensor([[self.step]])},
            },
            [1],
        )

    def act(self, td):
        active = PAIRS[self.pair % 2]
        self.position[active] = td["targets"][0, 0]
        move = self.position[active] - self.feet[active]
        self.feet[active] += move * (0.02 / move.norm(dim=-1, keepdim=True).clamp(min=0.02))
        self.step += 1
        if torch.allclose(self.feet[active], self.position[active], atol=1e-4):
            self.footholds = self.position.clone()
            self.pair += 1


@pytest.mark.parametrize(("weight", "walks"), [(50.0, True), (0.0, False)])
def test_the_high_level_policy_walks_a_scripted_stepper(weight, walks):
    stepper, hlp = Stepper(), make_policy(direction_weight=weight, start_step=0)
    for _ in range(120):
        stepper.act(hlp(stepper.observe()))
    moved = (stepper.feet - NOMINAL).mean(0)
    assert (moved[0].item() > 0.5) == walks, moved
    assert stepper.pair > 10
