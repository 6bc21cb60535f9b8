// The turns of a loop with a long body. Mesa's llvmpipe would unroll it and compile each turn anew, so it must not know how many they
// are; GPUs, which then load what several turns need at once, do.
int rolled(int turns) {
#ifdef SOFTWARE
    return gl_NumWorkGroups.x > 0u ? turns : 0;
#else
    return turns;
#endif
}
