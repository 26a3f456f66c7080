"""Other people's simulators on dsim's cloth; each is skipped where its package is not installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from dsim.studies.peers import PEERS, Peer, agreement, cloth_problem, load, of_program, twin
from dsim.studies.verdicts import judge_physics, judge_program

DIRECTORY = Path(__file__).parent / "peers"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_states_and_gradients_agree_and_are_right(peer: Peer) -> None:
    if not peer.installed:
        pytest.skip(f"the package {peer.package} is not installed: pip install -e '.[peers]'")
    problem = cloth_problem(n=3, steps=10)
    simulator = of_program(peer.name, load(DIRECTORY / peer.file), problem)
    found = agreement(simulator, twin(problem))
    assert found.ok, found
    assert judge_program(simulator).verdict == "right"
    assert judge_physics(simulator, refinements=(1, 2)).verdict == "converges"
