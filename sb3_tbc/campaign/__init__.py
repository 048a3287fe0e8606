"""Many runs: which are to do, how long they take, and carrying them out here, on Slurm or on a Ray cluster."""
