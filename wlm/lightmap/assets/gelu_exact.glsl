// x Phi(x). erf as in Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26: within 1.5e-7, which leaves
// GELU within 2.2e-7.
vec4 wlm_gelu(vec4 x)
{
    vec4 z = abs(x) * 0.70710678;
    vec4 t = 1.0 / (1.0 + 0.3275911 * z);
    vec4 p = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return 0.5 * x * (1.0 + sign(x) * (1.0 - p * exp(-1.0 * z * z)));
}
