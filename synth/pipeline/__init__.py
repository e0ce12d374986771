"""Who does what where: from a plan to a dataset, in this process, worker processes, a Ray cluster or shards.

    attempts             the random instances of a trajectory until one can be used
    batched_simulation   many trajectories simulated at once
    render_session       radiance of their frames
    finishing            flow, the cameras' noise, encoding, writing
    producer             all of it for one trajectory, in one process
    overlapped           batched simulation beside rendering beside writing
    worker_pool, ray_pool   processes and clusters that share the work
    generate             which trajectories are still to do, who does them, and what happened

What a sample holds depends on (scene, seed, index) alone, not on which other trajectories a process has made.
"""
