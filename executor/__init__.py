"""From a verified plan to motion: trajectory, set-points, safety gate, real-time loop, report."""
