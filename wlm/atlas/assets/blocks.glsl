    if (steps.x >= @code@u) {
        // Its first block, and from @code@ on its blocks less one, of @side@ texels a side.
        first *= @side@u;
        steps = (steps - uvec2(@code@u, @code@u)) * @side@u + uvec2(@last@u, @last@u);
        return wlm_atlas_blocks_at(vec2(first) + (x - vec2(tile)) * vec2(steps) + vec2(0.5, 0.5));
    }
