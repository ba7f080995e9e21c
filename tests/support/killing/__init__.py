"""A harness that kills recording processes at chosen moments and checks that nothing of them is lost."""
