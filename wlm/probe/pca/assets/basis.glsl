        number *= magnitude@unit@;
        for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d) {
            uint word = WLM_PROBE_PROBES(basis + (k - cluster - 1) * @words@ + d / @per_word@);
            values[d] += number * @number@;
        }
