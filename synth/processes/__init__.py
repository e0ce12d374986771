"""Work spread over worker processes of this machine.

pool         workers that each make whole trajectories, or finish rendered ones
batches      one process with solver and renderer, workers for everything else
ahead        an iterator that runs in a thread of its own
textures     painted ahead of their turn
threads      a worker's one core
"""

from synth.processes.batches import outcomes_of_batches
from synth.processes.pool import interrupts_blocked, leave_with_driver, outcomes_of_processes
from synth.processes.threads import cores

__all__ = ["cores", "interrupts_blocked", "leave_with_driver", "outcomes_of_batches", "outcomes_of_processes"]
