"""The U-Net that guidance is distilled into: it starts as its teacher, and learns."""

from types import SimpleNamespace

import pytest
import torch

from benchmarks.models import distil_guidance
from threestudio_gaussiandreamer.toybox import models
from threestudio_gaussiandreamer.toybox.unet_stage import UNetBatch

pytest.importorskip("diffusers")
SCALE = 4.0


@pytest.fixture
def stage():
    """Stand in for the U-Net's stage: a teacher that listens to its tokens, and random tokens."""
    torch.manual_seed(0)
    teacher = models.unet().eval()
    for name, value in teacher.named_parameters():
        if "conv_out" in name or "to_out" in name or "proj_out" in name:
            torch.nn.init.normal_(value, std=0.1)
    words = torch.randn(8, 4, models.TEXT_WIDTH)
    return SimpleNamespace(
        model=teacher.requires_grad_(False),
        scale=1.0,
        alphas_cumprod=torch.cumprod(1 - models.scheduler().betas.double(), dim=0),
        text_model=lambda ids: SimpleNamespace(last_hidden_state=words[ids]),
        tokens=lambda texts: words[7][None],
    )


@pytest.fixture
def case(stage):
    noise = torch.randn(2, 2, 4, 16, 16, generator=torch.Generator().manual_seed(1))
    batch = UNetBatch(*noise, t=torch.tensor([300, 800]), ids=torch.tensor([0, 1]))
    return distil_guidance.case_of(stage, batch, SCALE)


def test_the_target_is_the_teachers_guidance(stage, case):
    unconditional = (SCALE * case.conditional - case.guided) / (SCALE - 1)
    empty = stage.tokens([""]).expand_as(case.tokens)
    expected = stage.model(case.z, case.t, encoder_hidden_states=empty).sample
    torch.testing.assert_close(unconditional, expected, atol=1e-4, rtol=1e-4)


def test_the_student_starts_as_its_teacher_and_learns(stage, case):
    student = distil_guidance.student_of(stage.model)
    assert distil_guidance.relative_error(student, case) == pytest.approx(1.0, abs=1e-4)
    optimizer = torch.optim.Adam(student.parameters(), 1e-3)
    for _ in range(5):
        optimizer.zero_grad()
        distil_guidance.error(student, case).backward()
        optimizer.step()
    assert distil_guidance.relative_error(student, case) < 0.8
    assert student.time_embedding.cond_proj.weight.abs().max() > 0


def test_the_rate_rises_and_falls():
    rates = [distil_guidance.rate_at(step, step / 100) for step in range(100)]
    assert max(rates) == distil_guidance.RATE and rates[0] < rates[10] > rates[99]
