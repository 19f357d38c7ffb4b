// Philox4x32-10, a counter-based generator: the words of (key, counter) depend on nothing else, so
// any thread can make the jitter of any point, forward and again in backward.
// Salmon, Moraes, Dror, Shaw: "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
//
// A register of counters runs at once, each 32-bit word in the lower half of a 64-bit lane. The
// upper halves hold whatever the last product left there: the next product does not read them.
#pragma once

#include "simd.h"

namespace darswin {
namespace {

// The four words for each counter, 128 bits in two parts, in the lower halves of word[0..3].
inline void philox(uint64_t key, Words counter, uint64_t counter_upper, Words word[4]) {
  uint32_t k0 = static_cast<uint32_t>(key), k1 = static_cast<uint32_t>(key >> 32);
  Words c0 = counter, c1 = counter >> 32;
  Words c2 = splat<Words>(counter_upper), c3 = splat<Words>(counter_upper >> 32);
#pragma GCC unroll 10
  for (int round = 0; round < 10; ++round) {
    const Words p0 = lower_product(c0, 0xD2511F53), p1 = lower_product(c2, 0xCD9E8D57);
    c0 = (p1 >> 32) ^ c1 ^ splat<Words>(uint64_t{k0});
    c2 = (p0 >> 32) ^ c3 ^ splat<Words>(uint64_t{k1});
    c1 = p1;
    c3 = p0;
    k0 += 0x9E3779B9;
    k1 += 0xBB67AE85;
  }
  word[0] = c0;
  word[1] = c1;
  word[2] = c2;
  word[3] = c3;
}

}  // namespace
}  // namespace darswin
