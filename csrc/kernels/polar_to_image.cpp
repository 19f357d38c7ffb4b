// A polar map as an image.
//
// polar_sample knows where its points lie in the image; here each pixel asks where it lies in the
// map. Its radius and azimuth follow from its place, for a register of pixels at once, and the ring
// below it from its neighbour's, since radii change little from pixel to pixel. What is left of a
// pixel is four tokens and their weights; its channels are then four products a register.
//
// Inside the centre of the first ring the inner neighbour lies across the pole, half a turn away:
// the map goes on there at negative radii.
//
// Backward adds each pixel's gradient to its four tokens. An item is all pixels of some rows, and a
// few channels, whose sums stay in the cache: no two items write the same place.
#include "../polar_to_image.h"

#include "arena.h"
#include "math.h"
#include "transpose.h"
#include "trig.h"

namespace darswin {
namespace {

constexpr int64_t kTile = 64;  // pixels that are planned together; a multiple of every register

template <typename T>
inline T smaller(T a, T b) {
  return b < a ? b : a;
}

// Where the pixels of a tile lie in the map.
template <typename Real>
struct Plan {
  int64_t token[4][kTile];  // inner ring left, right; outer ring left, right
  Real weight[4][kTile];
  bool known[kTile];  // else the pixel is zero

  // For the gradients of the lens alone.
  int64_t inner[kTile], outer[kTile];
  bool pole[kTile];
  Real t[kTile], left[kTile], right[kTile];  // shares of the outer ring, and of the right sectors
  Real across[kTile], down[kTile], radius[kTile];
};

template <typename T, typename Real>
class Planner {
 public:
  using Args = PolarToImageArgs<T, Real>;
  using V = Vector<Real, kLanes<Real>>;

  explicit Planner(const Args& args) : a(args) {}

  // Plans `count` pixels of a row of image b, from pixel `first` on.
  void plan(int64_t b, int64_t row, int64_t first, int64_t count, Plan<Real>& plan) {
    const Real* radii = a.radii + (a.radii_rows == 1 ? 0 : b) * a.rings;
    const Real limit = a.r_max == nullptr ? static_cast<Real>(__builtin_inf())
                                          : a.r_max[a.r_max_rows == 1 ? 0 : b];
    if (first == 0) above = 0;  // what a pixel gets does not depend on who computes it
    place(a.place_rows == 1 ? 0 : b, row, first, count, plan);
    const Real per_turn = static_cast<Real>(a.sectors / (2 * kPi));
    const Real half = static_cast<Real>(0.5) * static_cast<Real>(a.sectors);
    for (int64_t k = 0; k < count; k += kLanes<Real>) {
      const V x = load<V>(plan.across + k), y = load<V>(plan.down + k);
      store(plan.radius + k, x * x + y * y);
      store(plan.right + k, arc_tangent(y, x) * per_turn - static_cast<Real>(0.5));
    }
    for (int64_t k = 0; k < count; ++k) plan.radius[k] = root(plan.radius[k]);
    for (int64_t k = 0; k < count; ++k) {
      const Real r = plan.radius[k], column = plan.right[k];
      // Infinity less itself is NaN, which is not below the limit either.
      plan.known[k] = plan.across[k] - plan.across[k] == 0 && plan.down[k] - plan.down[k] == 0 &&
                      r <= limit && r < static_cast<Real>(__builtin_inf());
      if (!plan.known[k]) {
        for (int corner = 0; corner < 4; ++corner) {
          plan.token[corner][k] = 0;
          plan.weight[corner][k] = 0;
        }
        continue;
      }
      while (above < a.rings && radii[above] <= r) ++above;
      while (above > 0 && radii[above - 1] > r) --above;
      const bool pole = above == 0, beyond = above == a.rings;
      const int64_t inner = pole ? 0 : above - 1, outer = beyond ? inner : above;
      const Real from = pole ? -radii[0] : radii[inner];
      const Real t = beyond ? 0 : (r - from) / (radii[outer] - from);
      const auto [l0, r0, share0] = neighbours(pole ? column + half : column);
      const auto [l1, r1, share1] = neighbours(column);
      plan.token[0][k] = (inner * a.sectors + l0) * a.channels;
      plan.token[1][k] = (inner * a.sectors + r0) * a.channels;
      plan.token[2][k] = (outer * a.sectors + l1) * a.channels;
      plan.token[3][k] = (outer * a.sectors + r1) * a.channels;
      plan.weight[0][k] = (1 - t) * (1 - share0);
      plan.weight[1][k] = (1 - t) * share0;
      plan.weight[2][k] = t * (1 - share1);
      plan.weight[3][k] = t * share1;
      plan.inner[k] = inner, plan.outer[k] = outer, plan.pole[k] = pole;
      plan.t[k] = t, plan.left[k] = share0, plan.right[k] = share1;
    }
  }

 private:
  struct Neighbours {
    int64_t left, right;
    Real share;  // of the right one
  };

  // Of a column in [-A, 2 A), around the ring.
  Neighbours neighbours(Real column) const {
    int64_t left = static_cast<int64_t>(column);
    left -= static_cast<Real>(left) > column;  // towards minus infinity
    const Real share = column - static_cast<Real>(left);
    while (left < 0) left += a.sectors;
    while (left >= a.sectors) left -= a.sectors;
    const int64_t right = left + 1 == a.sectors ? 0 : left + 1;
    return {left, right, share};
  }

  // The pixels on the polar plane. Behind the last one up to the end of its register stand zeros.
  void place(int64_t n, int64_t row, int64_t first, int64_t count, Plan<Real>& plan) const {
    const int64_t whole = smaller(round_up(count, kLanes<Real>), kTile);
    for (int64_t k = count; k < whole; ++k) plan.across[k] = plan.down[k] = 0;
    if (a.points != nullptr) {
      const Real* from = a.points + ((n * a.height + row) * a.width + first) * 2;
      for (int64_t k = 0; k < count; ++k) {
        plan.across[k] = from[2 * k], plan.down[k] = from[2 * k + 1];
      }
      return;
    }
    const double* m = a.plane + n * kPlane;
    const double y = static_cast<double>(row) - m[1];
    for (int64_t k = 0; k < count; ++k) {
      const double x = static_cast<double>(first + k) - m[0];
      plan.across[k] = static_cast<Real>(m[2] * x + m[3] * y);
      plan.down[k] = static_cast<Real>(m[4] * x + m[5] * y);
    }
  }

  const Args& a;
  int64_t above = 0;  // ring centres that the last pixel was not inside of
};

// Values of a token, widened, and back.
inline Floats values(const float* from) { return load<Floats>(from); }
inline Doubles values(const double* from) { return load<Doubles>(from); }
inline Floats values(const bfloat16* from) { return widen_lanes(from); }
inline void put(float* to, const Floats& v) { store(to, v); }
inline void put(double* to, const Doubles& v) { store(to, v); }
inline void put(bfloat16* to, const Floats& v) { narrow_lanes(to, v); }
inline float value(float x) { return x; }
inline double value(double x) { return x; }
inline float value(bfloat16 x) { return widen(x); }
inline void put_one(float* to, float x) { *to = x; }
inline void put_one(double* to, double x) { *to = x; }
inline void put_one(bfloat16* to, float x) { *to = narrow(x); }

template <typename T, typename Real>
class Forward {
 public:
  using Args = PolarToImageArgs<T, Real>;
  using V = Vector<Real, kLanes<Real>>;
  static constexpr int64_t kL = kLanes<Real>;

  Forward(const Args& args, Plan<Real>& plan) : a(args), plan(plan), planner(args) {}

  void row(int64_t b, int64_t y) {
    const int64_t pixels = a.height * a.width;
    for (int64_t first = 0; first < a.width; first += kTile) {
      const int64_t count = smaller(kTile, a.width - first), place = y * a.width + first;
      planner.plan(b, y, first, count, plan);
      const T* map = a.x + b * a.rings * a.sectors * a.channels;
      if (a.tokens) {
        tokens(map, count, a.out + (b * pixels + place) * a.channels);
      } else {
        planes(map, count, a.out + b * a.channels * pixels + place, pixels);
      }
    }
  }

 private:
  V mix(const T* map, int64_t k, int64_t c) const {
    if (!plan.known[k]) return V{};
    const V inner = plan.weight[0][k] * values(map + plan.token[0][k] + c) +
                    plan.weight[1][k] * values(map + plan.token[1][k] + c);
    const V outer = plan.weight[2][k] * values(map + plan.token[2][k] + c) +
                    plan.weight[3][k] * values(map + plan.token[3][k] + c);
    return inner + outer;
  }
  Real mix_one(const T* map, int64_t k, int64_t c) const {
    if (!plan.known[k]) return 0;
    const Real inner = plan.weight[0][k] * value(map[plan.token[0][k] + c]) +
                       plan.weight[1][k] * value(map[plan.token[1][k] + c]);
    const Real outer = plan.weight[2][k] * value(map[plan.token[2][k] + c]) +
                       plan.weight[3][k] * value(map[plan.token[3][k] + c]);
    return inner + outer;
  }

  void tokens(const T* map, int64_t count, T* to) const {
    for (int64_t k = 0; k < count; ++k, to += a.channels) {
      int64_t c = 0;
      for (; c + kL <= a.channels; c += kL) put(to + c, mix(map, k, c));
      for (; c < a.channels; ++c) put_one(to + c, mix_one(map, k, c));
    }
  }

  void planes(const T* map, int64_t count, T* to, int64_t stride) const {
    int64_t c = 0;
    if constexpr (kSame<Real, float>) {
      for (; c + kL <= a.channels; c += kL) {
        int64_t k = 0;
        for (; k + kL <= count; k += kL) square(map, k, c, to + c * stride + k, stride);
        for (; k < count; ++k) {
          for (int64_t e = c; e < c + kL; ++e) put_one(to + e * stride + k, mix_one(map, k, e));
        }
      }
    }
    for (; c < a.channels; ++c) {
      for (int64_t k = 0; k < count; ++k) put_one(to + c * stride + k, mix_one(map, k, c));
    }
  }

  // kL channels of kL pixels, from pixel k and channel c on.
  void square(const T* map, int64_t k, int64_t c, T* to, int64_t stride) const {
    Floats rows[kL];
#pragma GCC unroll 16
    for (int i = 0; i < kL; ++i) rows[i] = mix(map, k + i, c);
    if constexpr (kSame<T, float>) {
      transpose_square(rows, to, stride);
    } else {
      float turned[kL * kL];
      transpose_square(rows, turned, kL);
      for (int64_t i = 0; i < kL; ++i) narrow_lanes(to + i * stride, load<Floats>(turned + i * kL));
    }
  }

  const Args& a;
  Plan<Real>& plan;
  Planner<T, Real> planner;
};

// Gradients of a tile's pixels, of channels [c, c + width), as rows of `row` values, zeros behind.
template <typename T, typename Real>
void gather(const PolarToImageArgs<T, Real>& a, int64_t b, int64_t place, int64_t count, int64_t c,
            int64_t width, int64_t row, Real* to) {
  const int64_t pixels = a.height * a.width;
  if (a.tokens) {
    const T* from = a.grad_out + (b * pixels + place) * a.channels + c;
    for (int64_t k = 0; k < count; ++k) {
      for (int64_t e = 0; e < width; ++e) to[k * row + e] = value(from[k * a.channels + e]);
      for (int64_t e = width; e < row; ++e) to[k * row + e] = 0;
    }
    return;
  }
  const T* from = a.grad_out + (b * a.channels + c) * pixels + place;
  int64_t e = 0;
  if constexpr (kSame<Real, float>) {
    constexpr int64_t kL = kLanes<float>;
    for (; e + kL <= width; e += kL) {
      int64_t k = 0;
      for (; k + kL <= count; k += kL) {
        Floats rows[kL];
#pragma GCC unroll 16
        for (int i = 0; i < kL; ++i) rows[i] = values(from + (e + i) * pixels + k);
        transpose_square(rows, to + k * row + e, row);
      }
      for (; k < count; ++k) {
        for (int64_t i = e; i < e + kL; ++i) to[k * row + i] = value(from[i * pixels + k]);
      }
    }
  }
  for (; e < width; ++e) {
    for (int64_t k = 0; k < count; ++k) to[k * row + e] = value(from[e * pixels + k]);
  }
  for (; e < row; ++e) {
    for (int64_t k = 0; k < count; ++k) to[k * row + e] = 0;
  }
}

// The working memory of a thread.
template <typename T, typename Real>
struct Workspace {
  Plan<Real>* plan;
  Real *gradients, *sums;
  int64_t used;

  Workspace(const PolarToImageArgs<T, Real>& a, void* memory) {
    Arena arena{static_cast<char*>(memory)};
    const bool backward = a.grad_out != nullptr;
    const int64_t row = round_up(a.channels, kLanes<Real>);
    plan = arena.take<Plan<Real>>(1);
    gradients =
        arena.take<Real>(backward ? kTile * (row > kChannelBlock ? row : kChannelBlock) : 0);
    sums = arena.take<Real>(backward ? a.rings * a.sectors * kChannelBlock : 0);
    used = arena.used;
  }
};

template <typename T, typename Real>
int64_t scratch(const PolarToImageArgs<T, Real>& a) {
  return Workspace<T, Real>(a, nullptr).used;
}

template <typename T, typename Real>
void forward(const PolarToImageArgs<T, Real>& a, int64_t begin, int64_t end, void* memory) {
  const Workspace<T, Real> work(a, memory);
  Forward<T, Real> forward(a, *work.plan);
  for (int64_t item = begin; item < end; ++item) forward.row(item / a.height, item % a.height);
}

template <typename T, typename Real>
void backward_map(const PolarToImageArgs<T, Real>& a, int64_t begin, int64_t end, void* memory) {
  using V = Vector<Real, kLanes<Real>>;
  constexpr int64_t kL = kLanes<Real>;
  const Workspace<T, Real> work(a, memory);
  Plan<Real>& plan = *work.plan;
  Planner<T, Real> planner(a);
  const int64_t blocks = (a.channels + kChannelBlock - 1) / kChannelBlock;
  const int64_t map = a.rings * a.sectors;
  for (int64_t item = begin; item < end; ++item) {
    const int64_t c = item % blocks * kChannelBlock, band = item / blocks % a.bands;
    const int64_t b = item / blocks / a.bands;
    const int64_t width = smaller(kChannelBlock, a.channels - c), row = round_up(width, kL);
    for (int64_t e = 0; e < map * row; ++e) work.sums[e] = 0;
    const int64_t rows = (a.height + a.bands - 1) / a.bands;
    for (int64_t y = band * rows; y < smaller((band + 1) * rows, a.height); ++y) {
      for (int64_t first = 0; first < a.width; first += kTile) {
        const int64_t count = smaller(kTile, a.width - first);
        planner.plan(b, y, first, count, plan);
        gather(a, b, y * a.width + first, count, c, width, row, work.gradients);
        for (int64_t k = 0; k < count; ++k) {
          if (!plan.known[k]) continue;
          const Real* g = work.gradients + k * row;
#pragma GCC unroll 4
          for (int corner = 0; corner < 4; ++corner) {
            Real* to = work.sums + plan.token[corner][k] / a.channels * row;
            const Real weight = plan.weight[corner][k];
            for (int64_t e = 0; e < row; e += kL) {
              store(to + e, load<V>(to + e) + weight * load<V>(g + e));
            }
          }
        }
      }
    }
    for (int64_t token = 0; token < map; ++token) {
      const int64_t to = (b * map + token) * a.channels + c;
      const Real* from = work.sums + token * row;
      if (a.bands > 1) {
        copy(from, width, a.partial + band * a.batch * map * a.channels + to);
      } else if constexpr (kSame<T, Real>) {
        copy(from, width, a.grad_x + to);
      } else {
        narrow_all(from, width, a.grad_x + to);
      }
    }
  }
}

template <typename T, typename Real>
void sum_bands(const PolarToImageArgs<T, Real>& a, int64_t begin, int64_t end) {
  const int64_t values = a.batch * a.rings * a.sectors * a.channels;
  for (int64_t k = begin; k < end; ++k) {
    Real sum = a.partial[k];
    for (int64_t band = 1; band < a.bands; ++band) sum += a.partial[band * values + k];
    put_one(a.grad_x + k, sum);
  }
}

// sum over channels of g times a token's values
template <typename T, typename Real>
double product(const Real* g, const T* token, int64_t channels) {
  using V = Vector<Real, kLanes<Real>>;
  constexpr int64_t kL = kLanes<Real>;
  V sums{};
  int64_t c = 0;
  for (; c + kL <= channels; c += kL) sums += load<V>(g + c) * values(token + c);
  double sum = 0;
  for (int64_t e = 0; e < kL; ++e) sum += sums[e];
  for (; c < channels; ++c) sum += static_cast<double>(g[c]) * value(token[c]);
  return sum;
}

template <typename T, typename Real>
void backward_lens(const PolarToImageArgs<T, Real>& a, int64_t begin, int64_t end, void* memory) {
  const Workspace<T, Real> work(a, memory);
  Plan<Real>& plan = *work.plan;
  Planner<T, Real> planner(a);
  const int64_t map = a.rings * a.sectors * a.channels, row = round_up(a.channels, kLanes<Real>);
  const double per_turn = a.sectors / (2 * kPi);
  for (int64_t item = begin; item < end; ++item) {
    const int64_t lens = item / a.height, y = item % a.height;
    const int64_t last = a.lenses == 1 ? a.batch : lens + 1;
    double *grad_radii = a.grad_rows + item * (a.rings + kSums), *sums = grad_radii + a.rings;
    for (int64_t b = lens; b < last; ++b) {
      const double* m = a.plane == nullptr ? nullptr : a.plane + (a.place_rows == 1 ? 0 : b) * 6;
      for (int64_t first = 0; first < a.width; first += kTile) {
        const int64_t count = smaller(kTile, a.width - first);
        planner.plan(b, y, first, count, plan);
        gather(a, b, y * a.width + first, count, int64_t{0}, a.channels, row, work.gradients);
        for (int64_t k = 0; k < count; ++k) {
          if (!plan.known[k]) continue;
          double s[4];  // how the loss changes with each corner's weight
          for (int corner = 0; corner < 4; ++corner) {
            s[corner] = product(work.gradients + k * row, a.x + b * map + plan.token[corner][k],
                                a.channels);
          }
          const double t = plan.t[k], left = plan.left[k], right = plan.right[k];
          const double by_t = (1 - right) * s[2] + right * s[3] - (1 - left) * s[0] - left * s[1];
          const double by_column = (1 - t) * (s[1] - s[0]) + t * (s[3] - s[2]);
          const double r = plan.radius[k], dx = plan.across[k], dy = plan.down[k];
          const Real* radii = a.radii + (a.radii_rows == 1 ? 0 : b) * a.rings;
          const int64_t inner = plan.inner[k], outer = plan.outer[k];
          double by_r = 0;
          if (plan.pole[k]) {  // t = (r + r_0) / (2 r_0)
            const double first_radius = radii[0];
            by_r = by_t / (2 * first_radius);
            grad_radii[0] -= by_t * r / (2 * first_radius * first_radius);
          } else if (outer != inner) {  // t = (r - r_inner) / (r_outer - r_inner)
            by_r = by_t / (static_cast<double>(radii[outer]) - radii[inner]);
            grad_radii[inner] -= by_r * (1 - t);
            grad_radii[outer] -= by_r * t;
          }
          if (r == 0) continue;
          const double turn = by_column * per_turn / (r * r);
          const double gx = by_r * dx / r - turn * dy, gy = by_r * dy / r + turn * dx;
          if (a.grad_points != nullptr) {
            Real* to = a.grad_points + ((lens * a.height + y) * a.width + first + k) * 2;
            to[0] += static_cast<Real>(gx), to[1] += static_cast<Real>(gy);
          } else {
            const double px = static_cast<double>(first + k) - m[0];
            const double py = static_cast<double>(y) - m[1];
            sums[0] += gx, sums[1] += gy;
            sums[2] += gx * px, sums[3] += gx * py, sums[4] += gy * px, sums[5] += gy * py;
          }
        }
      }
    }
  }
}

template <typename T, typename Real>
constexpr PolarToImageKernels<T, Real> kKernels = {.scratch = scratch<T, Real>,
                                                   .forward = forward<T, Real>,
                                                   .backward_map = backward_map<T, Real>,
                                                   .sum_bands = sum_bands<T, Real>,
                                                   .backward_lens = backward_lens<T, Real>};

}  // namespace

template <>
constinit const PolarToImageKernels<float, float>
    Kernels<PolarToImageKernels<float, float>, Tier::TIER>::table = kKernels<float, float>;
template <>
constinit const PolarToImageKernels<double, double>
    Kernels<PolarToImageKernels<double, double>, Tier::TIER>::table = kKernels<double, double>;
template <>
constinit const PolarToImageKernels<bfloat16, float>
    Kernels<PolarToImageKernels<bfloat16, float>, Tier::TIER>::table = kKernels<bfloat16, float>;

}  // namespace darswin
