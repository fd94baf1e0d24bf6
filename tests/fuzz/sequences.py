"""Random sequences of operations on a cloud, whose Gaussians have ids in colour and moments."""

import copy
from typing import Any

import torch
from hypothesis import HealthCheck, settings, stateful
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from torch import Tensor

from tests.fuzz.targets import require_picture
from threestudio_gaussiandreamer.gaussians.densify import Change
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.splatting import Rasterized
from threestudio_gaussiandreamer.training.density import DECAY, DensityControl
from threestudio_gaussiandreamer.training.geometry import STATISTICS, GaussianCloud

EXTREMES = [
    *(("means", value) for value in (0.0, 1e4, -1e30, 3e38)),
    *(("log_scales", value) for value in (-1e30, -1000.0, -104.0, 0.0, 88.7, 1000.0, 3e38)),
    *(("quats", value) for value in (0.0, 1e-42, 1e30, -3e38)),
    *(("logit_opacities", value) for value in (-3e38, -1000.0, -15.0, 15.0, 1000.0, 3e38)),
]
FLOORS, CAPS = (1, 2, 64), (64, 65, 90, 500)
SEEDS = st.integers(0, 2**31 - 1)


class CloudSequence(RuleBasedStateMachine):
    """Operations on a cloud, and the invariants that hold after each."""

    steps = 0
    """Operations that were run, in all sequences."""

    @initialize(
        count=st.integers(1, 90), floor=st.sampled_from(FLOORS), cap=st.sampled_from(CAPS),
        seed=SEEDS, stepped=st.booleans(),
    )  # fmt: skip
    def start(self, count: int, floor: int, cap: int, seed: int, stepped: bool) -> None:
        self.g = torch.Generator().manual_seed(seed)
        densify = {"enabled": True, "start": 0, "stop": 10}
        limits = {"min_gaussians": floor, "max_gaussians": cap}
        self.cloud = GaussianCloud({**limits, "densify": densify})
        shapes = (count, 3), (count, 4), (count, 3), (count,), (count, 1, 3)
        arrays = Gaussians(*(torch.randn(shape, generator=self.g) for shape in shapes))
        self.cloud.set_arrays(**arrays._asdict())
        self.optimizer = torch.optim.Adam(self.cloud.parameter_groups(), lr=0.0)
        self.next_id, self.changes = 1, []
        if stepped:
            self.step(seed)
        self._mark(torch.ones(count, dtype=torch.bool))
        self._record_changes()

    @rule(seed=SEEDS)
    def step(self, seed: int) -> None:
        """Take an optimiser step that keeps the ids."""
        CloudSequence.steps += 1
        g = torch.Generator().manual_seed(seed)
        for group in self.optimizer.param_groups:
            group["lr"] = 0.0 if group["name"] in ("sh0", "sh_rest") else 0.1
        for parameter in self.cloud.parameters():
            parameter.grad = torch.randn(parameter.shape, generator=g)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self._stamp_moments()

    @rule(seed=SEEDS, bad=st.booleans(), views=st.integers(1, 3))
    def see(self, seed: int, bad: bool, views: int) -> None:
        """Record gradients and contributions of a step; gradients may be NaN or infinite."""
        CloudSequence.steps += 1
        g, n = torch.Generator().manual_seed(seed), len(self.cloud)
        means2d = torch.zeros(views, n, 2, requires_grad=True)
        sizes = 10.0 ** torch.randint(-8, 3, (views, n, 1), generator=g)
        means2d.grad = torch.randn(views, n, 2, generator=g) * sizes
        if bad:
            rows = torch.rand(views, n, generator=g) < 0.2
            means2d.grad[rows] = torch.tensor([float("nan"), float("inf")])
        seen = (torch.rand(views, n, generator=g) < 0.7).float()
        contribution = torch.rand(views, n, generator=g).mul(4).round() / 4 * seen
        nothing = torch.zeros(views, 1, 1, 1)
        out = Rasterized(nothing, nothing, nothing, means2d, seen * 3, contribution)
        DensityControl(self.cloud).after_backward(out, 64, 64)

    @rule(
        seed=SEEDS, threshold=st.sampled_from([0.0, 1e-6, 1e-3, 1e9]),
        split=st.sampled_from([1e-12, 0.05, 1e6]), faint=st.sampled_from([0.0, 0.05, 0.999]),
        huge=st.sampled_from([1e-9, 0.4, 1e30]),
    )  # fmt: skip
    def densify(self, seed: int, threshold: float, split: float, faint: float, huge: float) -> None:
        self.see(seed, bad=seed % 4 == 0, views=1)
        options = {"grad_threshold": threshold, "split_scale": split, "every": 1}
        self._round(densify=options | {"min_opacity": faint, "max_scale": huge})

    @rule(budget=st.sampled_from([64, 65, 80, 400]), keep=st.floats(0.01, 0.99))
    def prune(self, budget: int, keep: float) -> None:
        self._round(budget=budget, prune={"keep": keep})

    @rule(keep=st.floats(0.01, 0.99), gain=st.floats(0.01, 5.9), error=st.floats(0, 1e30))
    def prune_as_far_as_it_pays(self, keep: float, gain: float, error: float) -> None:
        self.cloud.error.fill_(error)
        self._round(budget="auto", prune={"keep": keep, "gain": gain})

    @rule(seed=SEEDS, budget=st.sampled_from([64, 70, "auto"]))
    def densify_and_prune(self, seed: int, budget: Any) -> None:
        self.see(seed, bad=False, views=2)
        self._round(budget=budget, densify={"grad_threshold": 0.0, "every": 1}, prune={"keep": 0.5})

    @rule(extreme=st.sampled_from(EXTREMES), share=st.floats(0, 1), seed=SEEDS)
    def set_extreme(self, extreme: tuple[str, float], share: float, seed: int) -> None:
        """Set parameters to extreme finite values."""
        CloudSequence.steps += 1
        values, g = getattr(self.cloud, extreme[0]), torch.Generator().manual_seed(seed)
        with torch.no_grad():
            values[torch.rand(values.shape, generator=g) < share] = extreme[1]

    @rule()
    def resume(self) -> None:
        """Copy the state into another cloud and optimiser, as a checkpoint does."""
        CloudSequence.steps += 1
        other = GaussianCloud(self.cloud.cfg)
        other.load_state_dict(copy.deepcopy(self.cloud.state_dict()))
        optimizer = torch.optim.Adam(other.parameter_groups(), lr=0.0)
        optimizer.load_state_dict(self.optimizer.state_dict())
        self.cloud, self.optimizer = other, optimizer
        self._record_changes()

    @precondition(lambda self: hasattr(self, "cloud"))
    @rule()
    def draw(self) -> None:
        CloudSequence.steps += 1
        require_picture(self.cloud)
        self.optimizer.zero_grad()

    @invariant()
    def everything_fits(self) -> None:
        n, parameters = len(self.cloud), self.cloud.parameters_by_name()
        statistics = [getattr(self.cloud, name) for name in STATISTICS]
        assert all(len(value) == n for value in parameters.values())
        assert all(value.shape == (n,) and value.isfinite().all() for value in statistics)
        assert all(v.isfinite().all() for v in parameters.values()), "a parameter isn't finite"
        held = [id(p) for group in self.optimizer.param_groups for p in group["params"]]
        mine = [v for v in parameters.values() if v.numel() or v is not self.cloud.sh_rest]
        assert held == [id(value) for value in mine], "the optimiser holds stale tensors"
        assert {id(value) for value in self.optimizer.state} <= set(held)

    @invariant()
    def moments_follow_their_gaussian(self) -> None:
        ids = self._ids()
        assert len(ids.unique()) == len(ids), "two Gaussians with the same id"
        for value, state in self.optimizer.state.items():
            assert state["exp_avg"].shape == value.shape == state["exp_avg_sq"].shape
            rows = state["exp_avg"].reshape(len(ids), -1)
            assert (rows == ids[:, None]).all(), "a row of moments is misplaced"

    def _round(self, budget: Any = None, densify: dict | None = None, prune: dict | None = None):
        """Run one round of densification, pruning or both, and check its bounds."""
        CloudSequence.steps += 1
        rules, before = self.cloud.cfg, len(self.cloud)
        parameters = self.cloud.parameters_by_name().items()
        old = {name: value.detach().clone() for name, value in parameters}
        if budget == "auto":
            rates = {group["name"]: group["lr"] for group in self.optimizer.param_groups}
            old["logit_opacities"] -= DECAY * rates["logit_opacities"]
        rules.budget, rules.densify.enabled = budget, densify is not None
        for section, options in ((rules.densify, densify), (rules.prune, prune)):
            vars(section).update(options or {})
        rules.prune.start, rules.prune.stop, rules.prune.every = 0, 10, 1
        self.changes.clear()
        steps = [state["step"].item() for state in self.optimizer.state.values()]
        DensityControl(self.cloud).after_step(self.optimizer, 5)
        assert steps == [state["step"].item() for state in self.optimizer.state.values()]
        assert min(before, rules.min_gaussians) <= len(self.cloud), "below the floor"
        cap = before if densify is None else rules.max_gaussians
        assert len(self.cloud) <= cap, "above the cap"
        for change in self.changes:
            self._check_change(change, old)

    def _check_change(self, change: Change, old: dict[str, Tensor]) -> None:
        """Check kept Gaussians, in order and unchanged, and new ones, which are marked."""
        stays = ~change.is_new
        assert (change.parents[stays].diff() > 0).all(), "the order changed"
        for name, value in self.cloud.parameters_by_name().items():
            kept = old[name][change.parents[stays]]
            assert torch.equal(value.detach()[stays], kept), f"{name} of one that stays changed"
        for state in self.optimizer.state.values():
            assert all((state[key][change.is_new] == 0).all() for key in ("exp_avg", "exp_avg_sq"))
        self._mark(change.is_new)

    def _record_changes(self) -> None:
        apply = self.cloud.apply_change

        def record(change: Change, optimizer: Any) -> None:
            self.changes.append(change)
            apply(change, optimizer)

        self.cloud.apply_change = record

    def _ids(self) -> Tensor:
        return self.cloud.sh0.detach()[:, 0, 0]

    def _mark(self, rows: Tensor) -> None:
        """Give these rows new ids, in colour and moments."""
        with torch.no_grad():
            new = torch.arange(self.next_id, self.next_id + int(rows.sum()), dtype=torch.float32)
            self.cloud.sh0[rows] = new[:, None, None].expand(-1, 1, 3) * torch.tensor([1.0, 0, 0])
        self.next_id += len(new)
        self._stamp_moments(rows)

    def _stamp_moments(self, rows: Any = slice(None)) -> None:
        ids = self._ids()
        for value, state in self.optimizer.state.items():
            shape = (-1, *[1] * (value.dim() - 1))
            state["exp_avg"][rows] = ids.reshape(shape).expand(value.shape)[rows]


def run_sequences(count: int, **options: Any) -> None:
    """Run the same sequences every time; invariants hold after every rule."""
    options |= {"derandomize": True, "deadline": None, "database": None}
    options |= {"stateful_step_count": 20, "suppress_health_check": list(HealthCheck)}
    options |= {"max_examples": count}
    stateful.run_state_machine_as_test(CloudSequence, settings=settings(**options))
