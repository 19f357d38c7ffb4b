// Computes which four tokens of a polar map each pixel of an image needs, and their weights.
#pragma once

#include "../polar_to_image.h"
#include "arena.h"
#include "math.h"

namespace darswin {
namespace {

constexpr int64_t kTile = 64;  // pixels that are planned together; a multiple of every register

// An integer as wide as a real number.
template <typename Real>
using IndexOf = std::conditional_t<is_same_v<Real, double>, int64_t, int32_t>;

// The tokens and weights for a tile of pixels.
template <typename Real>
struct Mix {
  using Index = IndexOf<Real>;

  Index token[4][kTile];  // of the inner ring left, right; of the outer ring left, right
  Real weight[4][kTile];
  Index known[kTile];  // all ones, or 0 where the pixel is zero
};

// The intermediate results behind a Mix, which backward needs. Step, t and column are the position
// of a pixel in the map: a plan keeps these three.
template <typename Real>
struct Origin {
  Real across[kTile], down[kTile], radius[kTile];  // the place on the polar plane
  Real step[kTile];                // how many ring centres lie inside; -1 where the pixel is zero
  Real t[kTile];                   // share of the outer ring
  Real column[kTile];              // the azimuth in sectors
  Real left[kTile], right[kTile];  // share of the right sector in the inner and the outer ring
};

template <typename T>
class Planner {
 public:
  using Args = PolarToImageArgs<T>;
  using Real = Arithmetic<T>;
  using V = Vector<Real, kLanes<Real>>;
  using Index = IndexOf<Real>;
  using I = Vector<Index, kLanes<Real>>;

  // `steps` has room for 2 * (rings + 1) values.
  Planner(const Args& args, Real* steps) : a(args), from(steps) {}

  // Computes the positions of `count` pixels of a row of image b, starting at pixel `first`.
  void locate(int64_t b, int64_t row, int64_t first, int64_t count, Origin<Real>& plan) {
    const int64_t whole = round_up(count, kLanes<Real>);
    place(a.place_rows == 1 ? 0 : b, row, first, count, plan);
    for (int64_t k = count; k < whole; ++k) plan.across[k] = plan.down[k] = 0;
    for (int64_t k = 0; k < whole; ++k) {
      plan.radius[k] = root(plan.across[k] * plan.across[k] + plan.down[k] * plan.down[k]);
    }
    take_radii(a.radii_rows == 1 ? 0 : b);
    const Real infinity = static_cast<Real>(__builtin_inf());
    const Real limit = a.r_max == nullptr ? infinity : a.r_max[a.r_max_rows == 1 ? 0 : b];
    for (int64_t k = 0; k < whole; k += kLanes<Real>) locate_register(k, limit, plan);
  }

  // Reads the positions from the plan. Wrong numbers give a wrong position inside the map.
  void read(int64_t b, int64_t row, int64_t first, int64_t count, Origin<Real>& plan) const {
    const int64_t n = a.plans == 1 ? 0 : b;
    const Real* from = a.plan + (n * a.height + row) * kPosition * a.width + first;
    const auto rings = static_cast<Real>(a.rings), turn = static_cast<Real>(a.sectors) / 2;
    const auto within = [](Real least, Real x, Real most) {
      return x >= least ? (x < most ? x : most) : least;
    };
    for (int64_t k = 0; k < count; ++k) {
      plan.step[k] = within(-1, from[k], rings);
      plan.t[k] = from[a.width + k];
      plan.column[k] = within(-turn - 1, from[2 * a.width + k], turn);
    }
    for (int64_t k = count; k < round_up(count, kLanes<Real>); ++k) {
      plan.step[k] = -1, plan.t[k] = plan.column[k] = 0;
    }
  }

  // Computes the tokens and the weights of pixels from their positions.
  void mix(int64_t count, Mix<Real>& tile, Origin<Real>& plan) const {
    for (int64_t k = 0; k < count; k += kLanes<Real>) mix_register(k, tile, plan);
  }

 private:
  // Computes the places of the pixels on the polar plane.
  void place(int64_t n, int64_t row, int64_t first, int64_t count, Origin<Real>& plan) const {
    if (a.points != nullptr) {
      const Real* from = a.points + ((n * a.height + row) * a.width + first) * 2;
      for (int64_t k = 0; k < count; ++k) {
        plan.across[k] = from[2 * k], plan.down[k] = from[2 * k + 1];
      }
      return;
    }
    const double* m = a.plane + n * kPlane;
    const double y = static_cast<double>(row) - m[1], start = static_cast<double>(first);
    for (int32_t k = 0; k < static_cast<int32_t>(count); ++k) {  // int64 has no fast conversion
      const double x = start + k - m[0];
      plan.across[k] = static_cast<Real>(m[2] * x + m[3] * y);
      plan.down[k] = static_cast<Real>(m[4] * x + m[5] * y);
    }
  }

  // Computes the steps from ring to ring of lens n. Step k lies between the centres of rings k - 1
  // and k. It has a start and a length. Step 0 crosses the pole, and the last step has no end.
  void take_radii(int64_t n) {
    if (n == lens) return;
    lens = n;
    above = 0;
    radii = a.radii + n * a.rings;
    span = from + a.rings + 1;
    from[0] = -radii[0];
    for (int64_t k = 1; k <= a.rings; ++k) from[k] = radii[k - 1];
    for (int64_t k = 0; k < a.rings; ++k) span[k] = radii[k] - from[k];
    span[a.rings] = static_cast<Real>(__builtin_inf());
  }

  // Returns the largest lane, in every lane.
  template <int distance>
  static V largest(V v) {
    if constexpr (distance == 0) {
      return v;
    } else {
      const V other = shuffle<[](int lane) { return lane ^ distance; }>(v, v);
      return largest<distance / 2>(v > other ? v : other);
    }
  }

  // Finds the step that each pixel of a register lies in. The number of the step is the number of
  // ring centres that are at most as far out as the pixel. Radii change little from pixel to pixel,
  // so the search begins at the last result, and the pixels of a register lie in few steps.
  void locate_register(int64_t k, Real limit, Origin<Real>& plan) {
    const V x = load<V>(plan.across + k), y = load<V>(plan.down + k), r = load<V>(plan.radius + k);
    const V infinity = splat<V>(static_cast<Real>(__builtin_inf()));
    const Real lowest = largest<kLanes<Real> / 2>(r == r ? -r : -infinity)[0] * -1;
    const Real highest = largest<kLanes<Real> / 2>(r == r ? r : -infinity)[0];
    while (above < a.rings && radii[above] <= lowest) ++above;
    while (above > 0 && radii[above - 1] > lowest) --above;
    I within = I{} + static_cast<Index>(above);
    V begin = splat<V>(from[above]), length = splat<V>(span[above]);
    for (int64_t ring = above; ring < a.rings && radii[ring] <= highest; ++ring) {
      const I outside = r >= radii[ring];
      within -= outside;  // true is -1
      begin = select(outside, splat<V>(from[ring + 1]), begin);
      length = select(outside, splat<V>(span[ring + 1]), length);
    }
    // Infinity minus infinity is NaN, which is not equal to anything.
    const I known = (x - x == 0) & (y - y == 0) & (r <= limit) & (r < infinity);
    store(plan.step + k, select(known, __builtin_convertvector(within, V), V{} - 1));
    store(plan.t + k, (r - begin) / length);
    store(plan.column + k,
          arc_tangent(y, x, known) * static_cast<Real>(a.sectors / (2 * kPi)) - Real{0.5});
  }

  // Computes the tokens and the weights of a register of pixels.
  void mix_register(int64_t k, Mix<Real>& tile, Origin<Real>& plan) const {
    const V t = load<V>(plan.t + k), column = load<V>(plan.column + k);
    const I step = __builtin_convertvector(load<V>(plan.step + k), I);
    const I known = step >= 0, pole = step == 0, none{};
    const auto sectors = static_cast<Index>(a.sectors), last = static_cast<Index>(a.rings - 1);
    const V turn = splat<V>(static_cast<Real>(0.5) * static_cast<Real>(a.sectors));
    const auto side = [&](int ring, I of, V at, V weight, Real* share_to) {
      I left = __builtin_convertvector(at, I);
      left += __builtin_convertvector(left, V) > at;  // rounds towards minus infinity: true is -1
      const V share = at - __builtin_convertvector(left, V);
      left += (left < 0) & sectors;
      left += (left < 0) & sectors;  // a ring of one sector can be rounded beyond its end
      left -= (left >= sectors) & sectors;
      I right = left + 1;
      right -= (right >= sectors) & sectors;
      const I base = of * sectors;
      store(tile.token[2 * ring] + k, select(known, base + left, none));
      store(tile.token[2 * ring + 1] + k, select(known, base + right, none));
      store(tile.weight[2 * ring] + k, weight * (1 - share));
      store(tile.weight[2 * ring + 1] + k, weight * share);
      store(share_to + k, share);
    };
    side(0, step - 1 - pole, column + select(pole, turn, V{}), 1 - t, plan.left);
    side(1, select(step > last, I{} + last, step), column, t, plan.right);
    store(tile.known + k, known);
  }

  const Args& a;
  const Real* radii = nullptr;
  Real *from, *span = nullptr;
  int64_t lens = -1, above = 0;
};

// Returns how many rows of pixels one item of forward or of backward_map takes.
template <typename T>
int64_t rows_of_band(const PolarToImageArgs<T>& a) {
  return (a.height + a.bands - 1) / a.bands;
}

// The channels of a pixel are taken in registers of this many lanes if there are few channels. A
// single channel is taken as it is.
constexpr int64_t kFew = 4;
template <typename T>
int64_t lanes(const PolarToImageArgs<T>& a) {
  constexpr int64_t most = kLanes<Arithmetic<T>>;
  if (a.channels == 1) return 1;
  return a.channels <= kFew ? smaller(kFew, most) : most;
}

// The working memory of a thread. It keeps the mixes of whole rows of pixels for the next images
// and channels. Row y is kept at place y % rows.
template <typename T>
class Workspace {
  Arena arena;

 public:
  using Real = Arithmetic<T>;

  Planner<T> planner;
  Mix<Real>* tile;  // for backward through the lens
  Origin<Real>* origin;
  Real *gradients, *sums;
  int64_t bytes;

  Workspace(const PolarToImageArgs<T>& args, void* memory)
      : arena{static_cast<char*>(memory)},
        planner(args, arena.take<Real>(2 * (args.rings + 1))),
        a(args),
        shared(a.plans == 1),
        tiles(round_up(a.width, kTile) / kTile) {
    // Rows are kept if they are needed again and take no more memory than this.
    constexpr int64_t kMost = int64_t{16} << 20;
    const bool backward = a.grad_out != nullptr;  // null without channels too
    const bool again = backward || (a.batch > 1 && shared);
    const int64_t row_bytes = tiles * static_cast<int64_t>(sizeof(Mix<Real>));
    rows = again && rows_of_band(a) * row_bytes <= kMost ? rows_of_band(a) : 1;

    kept = arena.take<int64_t>(rows);
    mixes = arena.take<Mix<Real>>(rows * tiles);
    tile = arena.take<Mix<Real>>(1);
    origin = arena.take<Origin<Real>>(1);
    const int64_t row = round_up(a.channels, lanes(a));
    gradients =
        arena.take<Real>(backward ? kTile * (row > kChannelBlock ? row : kChannelBlock) : 0);
    sums = arena.take<Real>(backward ? a.rings * a.sectors * smaller(row, kChannelBlock) : 0);
    bytes = arena.used;
    for (int64_t k = 0; memory != nullptr && k < rows; ++k) kept[k] = -1;
  }

  // Returns the tiles of row y of image b. Images with the same lens share them.
  const Mix<Real>* row(int64_t b, int64_t y) {
    const int64_t at = y % rows, key = (shared ? 0 : b) * a.height + y;
    Mix<Real>* to = mixes + at * tiles;
    if (kept[at] == key) return to;
    kept[at] = key;
    for (int64_t tile = 0; tile < tiles; ++tile) {
      const int64_t first = tile * kTile;
      const int64_t count = smaller(kTile, a.width - first);
      if (a.plan == nullptr) {
        planner.locate(b, y, first, count, *origin);
      } else {
        planner.read(b, y, first, count, *origin);
      }
      planner.mix(count, to[tile], *origin);
    }
    return to;
  }

 private:
  const PolarToImageArgs<T>& a;
  const bool shared;
  const int64_t tiles;
  int64_t rows;
  int64_t* kept;  // the row whose mixes are kept at each place, or -1
  Mix<Real>* mixes;
};

}  // namespace
}  // namespace darswin
