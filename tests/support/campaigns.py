"""Campaigns of flights that are not flown: what the tests hand to datasets, reports and workers."""

import math
import os
import signal
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from hil.campaigns.config import Spec
from hil.campaigns.flying import Campaign, CampaignRow
from hil.campaigns.sampling import draw
from hil.laboratory.metrics import METRICS

BAD_PUSH = 8.0  # [N] from here on the planted robot fails


def spec_of(**values: object) -> Spec:
    """A campaign of the hover over one parameter and a push that half of the flights get."""
    push = {
        "kind": "push.y", "probability": 0.5, "start_s": 0.1, "size": {"uniform": [1.0, 12.0]},
    }  # fmt: skip
    tree: dict[str, object] = {
        "experiments": ["hover"],
        "duration_s": 0.3,
        "flights": 40,
        "parameters": {"actuators.tau": {"uniform": [0.04, 0.06]}},
        "faults": [push],
    }
    return Spec.model_validate(tree | values)


def planted(campaign: Campaign, index: int) -> CampaignRow:
    """A flight that fails by its push alone, at once."""
    drawn = draw(campaign.spec, index)
    size = float(drawn.faults[0].partition("=")[2]) if drawn.faults else 0.0
    metrics = dict.fromkeys(METRICS, 0.0) | {"max_y": size / 100.0, "flown": 0.3, "rms_x": math.nan}
    passed = size < BAD_PUSH
    return CampaignRow(
        **asdict(drawn), outcome="completed", error="", passed=passed, hash=f"{index:064x}", metrics=metrics,
        holds={"in_box": passed},
    )  # fmt: skip


def raising(campaign: Campaign, index: int) -> CampaignRow:
    """The third flight raises."""
    if index == 3:
        raise ZeroDivisionError("planted")
    return planted(campaign, index)


def killing(campaign: Campaign, index: int) -> CampaignRow:
    """The third flight kills its process, each time; the fifth the first time only."""
    once = Path(campaign.spec.settings[0])  # a path of the test's
    if index == 3 or (index == 5 and not once.exists()):
        if index == 5:
            once.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return planted(campaign, index)


def hanging(campaign: Campaign, index: int) -> CampaignRow:
    """The third flight hangs where nobody can ask it for anything."""
    while index == 3:
        time.sleep(0.05)
    return planted(campaign, index)


def in_order(campaign: Campaign, indices: Iterator[int]) -> Iterator[CampaignRow]:
    """What workers do, one flight after the other."""
    for index in indices:
        yield planted(campaign, index)
