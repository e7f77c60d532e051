
// Each state has its own rows of sheets.
vec3 @name@(@declared@, int sheet, float state)
{
    int before = min(int(state), @last@);
    int after = min(before + 1, @last@);
    float share = state - float(before);
    vec3 light = @row@(@given@, sheet + @stride@ * before, float(before));
    if (share <= 0.0)
        return light;
    return mix(light, @row@(@given@, sheet + @stride@ * after, float(after)), share);
}
