        // The last output is the logarithm of the magnitude.
        if (i + 4 > WLM_PROBE_OUTPUTS)
            light *= exp(min(y[@place@], 0.0));
