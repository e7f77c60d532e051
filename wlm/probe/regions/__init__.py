"""Sets of many probes, in regions that are fitted, stored, loaded and decoded one by one."""
