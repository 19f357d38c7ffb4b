// Computes the positions of the points of a polar grid, one register of points at a time.
//
// A polar grid is separable: point (i, j) needs only radius i and azimuth j. So two short vectors
// replace the whole (N_r, N_a, 2) mesh that grid_sample would read. Positions are computed in
// double. In float, a coordinate of 100 px is only accurate to 1e-5 px, which would be the largest
// error of the whole operation.
//
// Jitter moves a point by a fraction of a cell along both vectors. Its random numbers come from a
// counter-based generator, one word for each point, so that backward finds the same positions
// again.
//
// With a circular lens, a point lies at its radius and azimuth. A general lens has a matrix, which
// stretches circles to ellipses, or offsets, which move each point separately. The loops over
// points are compiled for both kinds (structs Circular and General), so circular lenses pay nothing
// for general ones.
#pragma once

#include "../polar.h"
#include "math.h"

namespace darswin {
namespace {

constexpr int kBlock = 1024;  // points that are processed at a time

using Masks = Vector<int64_t, kDoubles>;

// Computes the cosines and sines of n angles; n is a multiple of the lanes.
[[maybe_unused]] void directions(const double* angles, int64_t n, double* cosines, double* sines) {
  for (int64_t j = 0; j < n; j += kDoubles) {
    Doubles sin, cos;
    sin_cos(load<Doubles>(angles + j), &sin, &cos);
    store(cosines + j, cos);
    store(sines + j, sin);
  }
}

// Philox4x32-10, a counter-based generator. Its words depend only on (key, counter). So any thread
// can make the jitter of any point, in forward and again in backward. Source: Salmon, Moraes, Dror,
// Shaw: "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
//
// A register of counters runs at once. Each 32-bit word is in the lower half of a 64-bit lane. The
// upper half holds what the last product left there, and the next product does not read it. A
// counter has 128 bits, in two parts. Its four words come out in the lower halves of word[0..3].
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

// The random words of a block of points. Point p of the image gets word p % 4 of counter p / 4.
struct RandomWords {
  uint32_t word[kBlock + 8 * kLanes<uint64_t>];
  int64_t first;  // index of the block's first point in `word`

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
      constexpr auto lower = [](int i) { return i % 2 * lanes + i / 2; };
      constexpr auto upper = [](int i) { return i % 2 * lanes + (i + lanes) / 2; };
      store(word + k, (Halves)shuffle<lower>(front, back));
      store(word + k + 2 * lanes, (Halves)shuffle<upper>(front, back));
    }
  }
};

// A register of points.
struct Points {
  Doubles x, y;          // px
  Doubles cos, sin;      // of their azimuths
  Doubles radius;        // px
  Doubles across, down;  // d(x, y) / d(radius)
  Doubles shift;         // how far jitter moved them along the radius, in cells
  Masks clamped;         // lanes whose radius would have been negative
};

// A circular lens places points at their radius and azimuth around the center of image b.
template <typename T>
struct Circular {
  double x, y;

  Circular(const PolarSampleArgs<T>& a, int64_t b)
      : x(a.center[b * a.center_stride]), y(a.center[b * a.center_stride + 1]) {}

  void put(Points& p, int64_t) const {
    p.across = p.cos;
    p.down = p.sin;
    p.x = x + p.radius * p.across;
    p.y = y + p.radius * p.down;
  }
};

// A general lens also applies the matrix, and adds the offsets of points j to j + count of radius
// i.
template <typename T>
struct General {
  const Circular<T> center;
  double matrix[4] = {1, 0, 0, 1};
  const T *x_offsets = nullptr, *y_offsets = nullptr, *end;
  const int64_t count;

  General(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t j, int64_t count)
      : center(a, b), end(a.offsets_end), count(count) {
    if (a.affine != nullptr) {
      for (int e = 0; e < 4; ++e) matrix[e] = a.affine[b * a.affine_stride + e];
    }
    if (a.offsets == nullptr) return;
    x_offsets = a.offsets + b * a.offsets_stride + i * a.num_azimuths + j;
    y_offsets = x_offsets + a.num_radii * a.num_azimuths;
  }

  void put(Points& p, int64_t k) const {
    p.across = matrix[0] * p.cos + unfused(matrix[1] * p.sin);
    p.down = matrix[2] * p.cos + unfused(matrix[3] * p.sin);
    p.x = center.x + p.radius * p.across;
    p.y = center.y + p.radius * p.down;
    if (x_offsets == nullptr) return;
    p.x += read(x_offsets + k);
    p.y += read(y_offsets + k);
  }

  // Reads a register of offsets. The last register of all may not be whole. The offsets of the next
  // block are `count` further on. The hardware does not prefetch so far, so this function does.
  Doubles read(const T* from) const {
    using V = Vector<T, kDoubles>;
    __builtin_prefetch(from + count);
    if (end - from >= kDoubles) return __builtin_convertvector(load<V>(from), Doubles);
    Doubles part = {};
    for (int lane = 0; lane < end - from; ++lane) part[lane] = from[lane];
    return part;
  }
};

// Returns x, or NaN if x is infinite. Otherwise a radius of minus infinity would become 0 after it
// is moved and clamped.
inline double finite(double x) { return x - x == 0 ? x : __builtin_nan(""); }

// The largest distance of the points of a radius from the center, without their offsets. It is NaN
// if the radius or the matrix is NaN.
struct Reach {
  double x, y;
};
template <typename T>
Reach reach(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
  const T* radii = a.radii + b * a.radii_stride;
  double most = __builtin_fabs(radii[i]);
  if (a.jitter > 0) {
    const Steps steps(i, a.num_radii);
    for (int side = 0; side < 2; ++side) {
      most +=
          __builtin_fabs(static_cast<double>(radii[steps.above[side]]) - radii[steps.below[side]]);
    }
  }
  if (a.affine == nullptr) return {most, most};
  const T* matrix = a.affine + b * a.affine_stride;
  return {most * (__builtin_fabs(matrix[0]) + __builtin_fabs(matrix[1])),
          most * (__builtin_fabs(matrix[2]) + __builtin_fabs(matrix[3]))};
}

// Returns the largest offset along y of the points of radius i. NaN does not count.
template <typename T>
double largest_offset(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
  if (a.offsets == nullptr) return 0;
  const T* row = a.offsets + b * a.offsets_stride + (a.num_radii + i) * a.num_azimuths;
  using V = Vector<T, kLanes<T>>;
  V most{};
  int64_t j = 0;
  for (; j + kLanes<T> <= a.num_azimuths; j += kLanes<T>) {
    const V y = load<V>(row + j);
    most = larger(y < 0 ? -y : y, most);
  }
  T largest = 0;
  for (int lane = 0; lane < kLanes<T>; ++lane) largest = larger(most[lane], largest);
  for (; j < a.num_azimuths; ++j) largest = larger(row[j] < 0 ? -row[j] : row[j], largest);
  return largest;
}

// Does the work of locate_through() with jitter. `tiny` means that turns are so small that short
// sums give their sines.
template <bool tiny, typename T, typename Lens, typename Visit>
void locate_moved(const PolarSampleArgs<T>& a, const Lens& lens, int64_t b, int64_t i, int64_t j,
                  int64_t count, const RandomWords& random, const Visit& visit) {
  using Ints = Vector<int32_t, kDoubles>;
  const T* radii = a.radii + b * a.radii_stride;
  const double radius = finite(radii[i]);
  const Steps steps(i, a.num_radii);
  double step[2];
  for (int side = 0; side < 2; ++side) {
    step[side] = finite(static_cast<double>(radii[steps.above[side]]) - radii[steps.below[side]]);
  }
  const Doubles inner = splat<Doubles>(step[0]), outer = splat<Doubles>(step[1]);
  const double jitter = a.jitter, cell = 2 * kPi * a.jitter / a.num_azimuths;
  const double *cosines = a.cosines + j, *sines = a.sines + j;
  const uint32_t* words = random.word + random.first;
  for (int64_t k = 0; k < count; k += kDoubles) {
    // u and v in [-1/2, 1/2) come from the two halves of a word.
    const auto word = load<Vector<uint32_t, kDoubles>>(words + k);
    const Doubles u = to_doubles((Ints)(word >> 16));
    const Doubles v = to_doubles((Ints)(word & 0xFFFF));
    Points p;
    p.shift = u * (0x1p-16 * jitter) - 0.5 * jitter;
    const Doubles turn = v * (0x1p-16 * cell) - 0.5 * cell;
    const Doubles moved = radius + p.shift * select(p.shift < 0, inner, outer);
    p.clamped = moved < 0;
    p.radius = select(p.clamped, Doubles{}, moved);
    Doubles sin, cos;
    if constexpr (tiny) {
      tiny_sin_cos(turn, &sin, &cos);
    } else {
      sin_cos(turn, &sin, &cos);
    }
    const Doubles c = load<Doubles>(cosines + k), s = load<Doubles>(sines + k);
    p.cos = c * cos - s * sin;
    p.sin = s * cos + c * sin;
    lens.put(p, k);
    visit(k, p);
  }
}

// Does the work of locate() for one kind of lens, Circular or General.
template <typename T, typename Lens, typename Visit>
void locate_through(const PolarSampleArgs<T>& a, const Lens& lens, int64_t b, int64_t i, int64_t j,
                    int64_t count, RandomWords& random, const Visit& visit) {
  if (a.jitter > 0) {
    random.draw(a.seed, static_cast<uint64_t>(b), static_cast<uint64_t>(i * a.num_azimuths + j),
                count);
    if (sizeof(T) == sizeof(float) && kPi * a.jitter / a.num_azimuths <= kTiny) {
      return locate_moved<true>(a, lens, b, i, j, count, random, visit);
    }
    return locate_moved<false>(a, lens, b, i, j, count, random, visit);
  }
  const Doubles radius = splat<Doubles>(double{a.radii[b * a.radii_stride + i]});
  const double *cosines = a.cosines + j, *sines = a.sines + j;
  for (int64_t k = 0; k < count; k += kDoubles) {
    Points p;
    p.cos = load<Doubles>(cosines + k);
    p.sin = load<Doubles>(sines + k);
    p.radius = radius;
    p.shift = Doubles{};
    p.clamped = Masks{};
    lens.put(p, k);
    visit(k, p);
  }
}

// Calls visit(k, points) for points j + k, j + k + 1, ... of radius i of image b, with k < count.
// The last register may reach beyond count.
template <typename T, typename Visit>
void locate(const PolarSampleArgs<T>& a, int64_t b, int64_t i, int64_t j, int64_t count,
            RandomWords& random, const Visit& visit) {
  if (a.affine == nullptr && a.offsets == nullptr) {
    locate_through(a, Circular<T>(a, b), b, i, j, count, random, visit);
  } else {
    locate_through(a, General<T>(a, b, i, j, count), b, i, j, count, random, visit);
  }
}

}  // namespace
}  // namespace darswin
