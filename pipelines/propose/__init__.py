"""Job propose: tasks become raw layouts."""
