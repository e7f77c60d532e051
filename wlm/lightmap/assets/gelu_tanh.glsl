// The tanh form of GELU, which the model was trained with, as x / (1 + exp(-2 z)), since the tanh of drivers takes
// several times as long; within 4.8e-4 of the exact form.
vec4 wlm_gelu(vec4 x)
{
    vec4 z = x * (-2.3022082 - 0.10294324 * x * x); // for powers of 2, which end before a float overflows
    return x / (1.0 + exp2(min(z, vec4(80.0, 80.0, 80.0, 80.0))));
}
