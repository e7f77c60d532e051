        values[k - 1] = magnitude * number;
