"""The editor runs this file when it starts."""

import wlm_sample

wlm_sample.start()
