// Scalar maths for both types. Built-ins rather than <cmath>: an inline function of the standard
// library, emitted here with AVX, could be the copy that the linker keeps for the whole program.
#pragma once

namespace {

inline float exponential(float x) { return __builtin_expf(x); }
inline double exponential(double x) { return __builtin_exp(x); }
inline float logarithm(float x) { return __builtin_logf(x); }
inline double logarithm(double x) { return __builtin_log(x); }

}  // namespace
