// Where the samples of a polar grid stand, a register of points at a time.
//
// A polar grid is separable: point (i, j) needs radius i and azimuth j, so two short vectors stand
// for the whole (N_r, N_a, 2) mesh that grid_sample would read. Places are computed in double: in
// float a coordinate of 100 px is only good to 1e-5 px, the largest error of the whole operation.
// Jitter moves a point by a fraction of a cell along both vectors. Its numbers come from a
// counter-based generator, a word a point, so that backward finds the same places again.
#pragma once

#include "philox.h"
#include "simd.h"
#include "trig.h"

namespace {

using darswin::PolarSampleArgs;
using darswin::Steps;

constexpr int kBlock = 1024;  // points in hand at a time

using Masks = Vector<int64_t, kDoubles>;

// The random words of a block of points: word p % 4 of counter p / 4 for point p of the image.
struct RandomWords {
  uint32_t word[kBlock + 8 * kLanes<uint64_t>];
  int64_t first;  // place of the block's first point

  void draw(uint64_t seed, uint64_t image, uint64_t point, int64_t count) {
    constexpr int lanes = kLanes<uint64_t>;
    first = static_cast<int64_t>(point % 4);
    constexpr uint64_t steps[] = {0, 1, 2, 3, 4, 5, 6, 7};
    Words counter = load<Words>(steps) + point / 4;
    for (int64_t k = 0; k < first + count; k += 4 * lanes) {
      Words w[4];
      philox(seed, counter, image, w);
      counter += lanes;
      const Words front = (w[0] & 0xFFFFFFFF) | (w[1] << 32);
      const Words back = (w[2] & 0xFFFFFFFF) | (w[3] << 32);
      using Halves = Vector<uint32_t, 2 * lanes>;
      store(word + k, (Halves)interleave_lower(front, back));
      store(word + k + 2 * lanes, (Halves)interleave_upper(front, back));
    }
  }
};

// A register of points.
struct Points {
  Doubles x, y;      // px
  Doubles cos, sin;  // of their azimuths
  Doubles shift;     // how far jitter moved them along the radius, in cells
  Masks clamped;     // whether their radius would have been negative
};

// The largest distance from the center that a point of radius i may have; NaN if the radius is.
template <typename T>
double reach(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
  const T* radii = a.radii + b * a.radii_stride;
  double most = radii[i] < 0 ? -radii[i] : radii[i];
  if (a.jitter > 0) {
    const Steps steps(i, a.num_radii);
    for (int side = 0; side < 2; ++side) {
      const double step = static_cast<double>(radii[steps.above[side]]) - radii[steps.below[side]];
      most += step < 0 ? -step : step;
    }
  }
  return most;
}

// The part of locate() that jitter needs. With `tiny` turns their sines are short sums.
template <bool tiny, typename T, typename Visit>
void locate_moved(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t j, int64_t count,
                  const RandomWords& random, const Visit& visit) {
  using Ints = Vector<int32_t, kDoubles>;
  const T* radii = a.radii + b * a.radii_stride;
  const T* center = a.center + b * a.center_stride;
  const double cx = center[0], cy = center[1], radius = radii[i];
  const Steps steps(i, a.num_radii);
  double step[2];
  for (int side = 0; side < 2; ++side) {
    step[side] = static_cast<double>(radii[steps.above[side]]) - radii[steps.below[side]];
  }
  const Doubles inner = splat<Doubles>(step[0]), outer = splat<Doubles>(step[1]);
  const double jitter = a.jitter, cell = 2 * kPi * a.jitter / a.num_azimuths;
  const double *cosines = a.cosines + j, *sines = a.sines + j;
  const uint32_t* words = random.word + random.first;
  for (int64_t k = 0; k < count; k += kDoubles) {
    // u and v in [-1/2, 1/2) are the halves of a word.
    const auto word = load<Vector<uint32_t, kDoubles>>(words + k);
    const Doubles u = to_doubles((Ints)(word >> 16));
    const Doubles v = to_doubles((Ints)(word & 0xFFFF));
    Points p;
    p.shift = u * (0x1p-16 * jitter) - 0.5 * jitter;
    const Doubles turn = v * (0x1p-16 * cell) - 0.5 * cell;
    const Doubles moved = radius + p.shift * select(p.shift < 0, inner, outer);
    p.clamped = moved < 0;
    const Doubles r = select(p.clamped, Doubles{}, moved);
    Doubles sin, cos;
    if constexpr (tiny) {
      tiny_sin_cos(turn, &sin, &cos);
    } else {
      sin_cos(turn, &sin, &cos);
    }
    const Doubles c = load<Doubles>(cosines + k), s = load<Doubles>(sines + k);
    p.cos = c * cos - s * sin;
    p.sin = s * cos + c * sin;
    p.x = cx + r * p.cos;
    p.y = cy + r * p.sin;
    visit(k, p);
  }
}

// Calls visit(k, points) for points j + k, j + k + 1, ... of radius i of image b; k < count. The
// last register may reach beyond count.
template <typename T, typename Visit>
void locate(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t j, int64_t count,
            RandomWords& random, const Visit& visit) {
  if (a.jitter > 0) {
    random.draw(a.seed, static_cast<uint64_t>(b), static_cast<uint64_t>(i * a.num_azimuths + j),
                count);
    if (sizeof(T) == sizeof(float) && kPi * a.jitter / a.num_azimuths <= kTiny) {
      return locate_moved<true>(a, b, i, j, count, random, visit);
    }
    return locate_moved<false>(a, b, i, j, count, random, visit);
  }
  const T* center = a.center + b * a.center_stride;
  const double cx = center[0], cy = center[1], radius = a.radii[b * a.radii_stride + i];
  const double *cosines = a.cosines + j, *sines = a.sines + j;
  for (int64_t k = 0; k < count; k += kDoubles) {
    Points p;
    p.cos = load<Doubles>(cosines + k);
    p.sin = load<Doubles>(sines + k);
    p.x = cx + radius * p.cos;
    p.y = cy + radius * p.sin;
    p.shift = Doubles{};
    p.clamped = Masks{};
    visit(k, p);
  }
}

}  // namespace
