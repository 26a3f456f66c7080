"""Other people's simulators on dsim's cloth; each is skipped where its package is not installed."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
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


def test_mujoco_moves_free_bodies_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Five bodies of three different moments, forty steps: positions, attitudes, velocities and spins to round-off."""
    if find_spec("mujoco") is None:
        pytest.skip("the package mujoco is not installed: pip install -e '.[peers]'")
    monkeypatch.setattr(sys, "path", [str(DIRECTORY), *sys.path])
    import free_bodies
    import mujoco_bodies

    given = free_bodies.problem(5, steps=40, h=0.02)
    (q, v), (their_q, their_v) = free_bodies.ours(given)(), mujoco_bodies.make(given)()
    assert np.abs(q - their_q).max() < 1e-12 and np.abs(v - their_v).max() < 1e-12
    other, _ = free_bodies.ours({**given, "moments": 1.01 * given["moments"][:, ::-1]})()
    assert np.abs(other - their_q).max() > 1e-3
