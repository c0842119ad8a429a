"""The machine that a process runs on: device, threads, time, what is loaded ahead."""
