"""What several test files, the soak and the fuzzer share."""
