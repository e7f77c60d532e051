
#ifndef @macro@
#define @macro@(i) texelFetch(@texture@, ivec2((i) & 1023, (i) >> 10), 0)
#endif

vec4 @function@(int i)
{
    return @macro@(i);
}
