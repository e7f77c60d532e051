    // Both count blocks of @side@ texels a side.
    first *= @side@u;
    steps = steps * @side@u + uvec2(@last@u, @last@u);
