// Quotient of integers, at most 2^21, of a >= 0 by b > 0; by floats, because software renderers divide integers lane by lane.
int quotient(int a, int b) {
    int q = int(float(a) / float(b)), rest = a - q * b;   // q is off by one at most
    return q + int(rest >= b) - int(rest < 0);
}
