"""What solvers and registrations return: poses with their evidence, the steps that led to them, verdicts in words."""
