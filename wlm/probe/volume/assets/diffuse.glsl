
// The radiance of a white diffuse surface with unit normal n at a point: irradiance over pi, RGB, read in front of it.
// Orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2, all signs plus.
vec3 wlm_volume_diffuse(vec3 p, vec3 n)
{
    float values[@outputs@];
    wlm_volume_read(p, n, values);
    float weight[9];
    weight[0] = 0.282094792;
    weight[1] = 0.325735008 * n.y;
    weight[2] = 0.325735008 * n.z;
    weight[3] = 0.325735008 * n.x;
    weight[4] = 0.273137108 * n.x * n.y;
    weight[5] = 0.273137108 * n.y * n.z;
    weight[6] = 0.0788478913 * (3.0 * n.z * n.z - 1.0);
    weight[7] = 0.273137108 * n.x * n.z;
    weight[8] = 0.136568554 * (n.x * n.x - n.y * n.y);
    vec3 sum = vec3(0.0, 0.0, 0.0);
    for (int c = 0; c < @coefficients@; ++c)
        sum += weight[c] * vec3(values[3 * c], values[3 * c + 1], values[3 * c + 2]);
    return max(sum, vec3(0.0, 0.0, 0.0)); // few bands ring below 0
}
