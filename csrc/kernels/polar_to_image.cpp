// Turns a polar map into an image.
//
// polar_sample computes where its points lie in the image. This kernel goes the other way: it
// computes where each pixel lies in the map. The position of a pixel gives its radius and its
// azimuth, for one register of pixels at a time. The next step finds the two rings on both sides of
// the pixel. The search starts at the ring of the previous pixels, because radii change little from
// pixel to pixel. A pixel is then a weighted sum of four tokens, and each register of its channels
// takes four products.
//
// Inside the centre of the first ring, the inner neighbour lies on the other side of the pole, half
// a turn away. There the map continues at negative radii.
//
// Backward adds the gradient of each pixel to its four tokens. A work item covers a band of rows
// and a few channels, so that its sums stay in the cache. No two items write to the same place.
#include "../polar_to_image.h"

#include "polar_mix.h"

namespace darswin {
namespace {

// Reads the gradients of a tile's pixels for channels [c, c + width). Each pixel gets a row of
// `row` values, padded with zeros. `row` is a multiple of kL.
template <int64_t kL, typename T, typename Real = Arithmetic<T>>
void gather(const PolarToImageArgs<T>& a, int64_t b, int64_t place, int64_t count, int64_t c,
            int64_t width, int64_t row, Real* to) {
  using V = Vector<Real, kL>;
  constexpr int64_t kAhead = 16, kBytes = sizeof(T);
  const int64_t pixels = a.height * a.width;
  if (kL > 1 && a.tokens) {
    const T* from = a.grad_out + (b * pixels + place) * a.channels + c;
    for (int64_t k = 0; k < count; ++k, from += a.channels, to += row) {
      // The pieces lie far apart, so the hardware does not prefetch them.
      const char* ahead = reinterpret_cast<const char*>(from + kAhead * a.channels);
      for (int64_t byte = 0; byte < width * kBytes; byte += 64) __builtin_prefetch(ahead + byte);
      int64_t e = 0;
      for (; e + kL <= width; e += kL) store(to + e, load<V>(from + e));
      for (; e < width; ++e) to[e] = load<Real>(from + e);
      for (; e < row; ++e) to[e] = 0;
    }
    return;
  }
  const T* from = a.grad_out + (b * a.channels + c) * pixels + place;
  for (int64_t e = 0; e < row; e += kL) {
    const int64_t planes = smaller(kL, width - e);
    int64_t k = 0;
    if constexpr (is_same_v<Real, float> && kL > 1) {
      for (; k + kL <= count; k += kL) {
        V rows[kL]{};
        if (planes == kL) {
#pragma GCC unroll 16
          for (int i = 0; i < kL; ++i) {
            const T* plane = from + (e + i) * pixels + k;
            __builtin_prefetch(plane + kTile);
            rows[i] = load<V>(plane);
          }
        } else {
          for (int i = 0; i < planes; ++i) rows[i] = load<V>(from + (e + i) * pixels + k);
        }
        transpose_square(rows, to + k * row + e, row);
      }
    }
    for (; k < count; ++k) {
      for (int64_t i = e; i < e + kL; ++i) {
        to[k * row + i] = i < width ? load<Real>(from + i * pixels + k) : 0;
      }
    }
  }
}

template <typename T>
int64_t scratch(const PolarToImageArgs<T>& a) {
  return Workspace<T>(a, nullptr).bytes;
}

template <typename T>
void make_plan(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  Workspace<T> work(a, memory);
  const auto& origin = *work.origin;
  for (int64_t item = begin; item < end; ++item) {
    for (int64_t first = 0; first < a.width; first += kTile) {
      const int64_t count = smaller(kTile, a.width - first);
      work.planner.locate(item / a.height, item % a.height, first, count, *work.origin);
      auto* to = a.positions + item * kPosition * a.width + first;
      copy(origin.step, count, to);
      copy(origin.t, count, to + a.width);
      copy(origin.column, count, to + 2 * a.width);
    }
  }
}

// Adds the gradients of a tile's pixels, in rows of `row_` values, to the gradients of their
// tokens. `fixed` is the length of a row, or 0 if only the call knows it.
template <int64_t kL, int64_t fixed, typename Real>
void add(const Mix<Real>& tile, int64_t count, int64_t row_, const Real* gradients, Real* sums) {
  using V = Vector<Real, kL>;
  const int64_t row = fixed > 0 ? fixed : row_;
  for (int64_t k = 0; k < count; ++k, gradients += row) {
    if (!tile.known[k]) continue;
#pragma GCC unroll 4
    for (int corner = 0; corner < 4; ++corner) {
      Real* to = sums + tile.token[corner][k] * row;
      const Real weight = tile.weight[corner][k];
#pragma GCC unroll 8
      for (int64_t e = 0; e < row; e += kL) {
        store(to + e, load<V>(to + e) + weight * load<V>(gradients + e));
      }
    }
  }
}

// Copies rows of `row` values to places `stride` apart. Only the first `width` values of a row
// matter.
template <int64_t kL, typename From, typename To>
void copy_rows(const From* from, int64_t rows, int64_t row, int64_t width, To* to, int64_t stride) {
  if (width == row && width == stride) return copy(from, rows * row, to);
  if (row == kL && width == stride) {
    using V = Vector<From, kL>;
    // The next row overwrites the excess values.
    for (; rows * stride >= kL; --rows, from += row, to += stride) store(to, load<V>(from));
  }
  for (; rows > 0; --rows, from += row, to += stride) copy(from, width, to);
}

template <typename T, int64_t kL>
void backward_map_items(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  using Real = Arithmetic<T>;
  Workspace<T> work(a, memory);
  const int64_t blocks = (a.channels + kChannelBlock - 1) / kChannelBlock;
  const int64_t map = a.rings * a.sectors;
  for (int64_t item = begin; item < end; ++item) {
    const int64_t c = item % blocks * kChannelBlock, b = item / blocks % a.batch;
    const int64_t band = item / blocks / a.batch;
    const int64_t width = smaller(kChannelBlock, a.channels - c), row = round_up(width, kL);
    for (int64_t e = 0; e < map * row; ++e) work.sums[e] = 0;
    const int64_t rows = rows_of_band(a);
    for (int64_t y = band * rows; y < smaller((band + 1) * rows, a.height); ++y) {
      const Mix<Real>* tile = work.row(b, y);
      for (int64_t first = 0; first < a.width; first += kTile, ++tile) {
        const int64_t count = smaller(kTile, a.width - first);
        gather<kL>(a, b, y * a.width + first, count, c, width, row, work.gradients);
        if (row == kChannelBlock) {
          add<kL, kChannelBlock>(*tile, count, row, work.gradients, work.sums);
        } else if (row == kL) {
          add<kL, kL>(*tile, count, row, work.gradients, work.sums);
        } else {
          add<kL, 0>(*tile, count, row, work.gradients, work.sums);
        }
      }
    }
    const int64_t to = b * map * a.channels + c;
    if (a.bands > 1) {
      Real* partial = a.partial + band * a.batch * map * a.channels;
      copy_rows<kL>(work.sums, map, row, width, partial + to, a.channels);
    } else {
      copy_rows<kL>(work.sums, map, row, width, a.grad_x + to, a.channels);
    }
  }
}

// Calls one of the functions above, with the number of lanes that suits the channels.
template <typename T>
void forward(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  constexpr int64_t most = kLanes<Arithmetic<T>>, few = most < kFew ? most : kFew;
  auto* items = lanes(a) == few ? forward_items<T, few, 0> : forward_items<T, most, 0>;
  if (a.channels == 1) items = forward_items<T, 1, 1>;
  if (a.channels == 3) items = forward_items<T, few, 3>;
  items(a, begin, end, memory);
}
template <typename T>
void backward_map(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  constexpr int64_t most = kLanes<Arithmetic<T>>, few = most < kFew ? most : kFew;
  auto* items = lanes(a) == few ? backward_map_items<T, few> : backward_map_items<T, most>;
  if (a.channels == 1) items = backward_map_items<T, 1>;
  items(a, begin, end, memory);
}

template <typename T>
void sum_bands(const PolarToImageArgs<T>& a, int64_t begin, int64_t end) {
  using V = Vector<Arithmetic<T>, kLanes<Arithmetic<T>>>;
  const int64_t values = a.batch * a.rings * a.sectors * a.channels;
  const auto sum = [&]<typename W>(int64_t k, W total) {
    for (int64_t band = 0; band < a.bands; ++band) {
      const W part = load<W>(a.partial + band * values + k);
      total = band == 0 ? part : total + part;
    }
    store(a.grad_x + k, total);
  };
  int64_t k = begin;
  for (; k + kLanes<Arithmetic<T>> <= end; k += kLanes<Arithmetic<T>>) sum(k, V{});
  for (; k < end; ++k) sum(k, Arithmetic<T>{});
}

// Returns the sum over the channels of g times the values of a token.
template <typename T, typename Real = Arithmetic<T>>
double product(const Real* g, const T* token, int64_t channels) {
  using V = Vector<Real, kLanes<Real>>;
  constexpr int64_t kL = kLanes<Real>;
  V sums{};
  int64_t c = 0;
  for (; c + kL <= channels; c += kL) sums += load<V>(g + c) * load<V>(token + c);
  double sum = 0;
  for (int64_t e = 0; e < kL; ++e) sum += sums[e];
  for (; c < channels; ++c) sum += static_cast<double>(g[c]) * load<Real>(token + c);
  return sum;
}

template <typename T>
void backward_lens(const PolarToImageArgs<T>& a, int64_t begin, int64_t end, void* memory) {
  using Real = Arithmetic<T>;
  Workspace<T> work(a, memory);
  Mix<Real>& tile = *work.tile;
  Origin<Real>& plan = *work.origin;
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
        work.planner.locate(b, y, first, count, plan);
        work.planner.mix(count, tile, plan);
        gather<kLanes<Real>>(a, b, y * a.width + first, count, int64_t{0}, a.channels, row,
                             work.gradients);
        for (int64_t k = 0; k < count; ++k) {
          if (!tile.known[k]) continue;
          double s[4];  // the derivatives of the loss by the weights of the corners
          for (int corner = 0; corner < 4; ++corner) {
            s[corner] = product(work.gradients + k * row,
                                a.x + b * map + a.channels * tile.token[corner][k], a.channels);
          }
          const double t = plan.t[k], left = plan.left[k], right = plan.right[k];
          const double by_t = (1 - right) * s[2] + right * s[3] - (1 - left) * s[0] - left * s[1];
          const double by_column = (1 - t) * (s[1] - s[0]) + t * (s[3] - s[2]);
          const double r = plan.radius[k], dx = plan.across[k], dy = plan.down[k];
          const Real* radii = a.radii + (a.radii_rows == 1 ? 0 : b) * a.rings;
          const auto outer = smaller(static_cast<int64_t>(plan.step[k]), a.rings - 1);
          const auto inner = static_cast<int64_t>(plan.step[k]) - 1;
          double by_r = 0;
          if (inner < 0) {  // t = (r + r_0) / (2 r_0)
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

template <typename T>
constexpr PolarToImageKernels<T> kKernels = {.scratch = scratch<T>,
                                             .make_plan = make_plan<T>,
                                             .forward = forward<T>,
                                             .backward_map = backward_map<T>,
                                             .sum_bands = sum_bands<T>,
                                             .backward_lens = backward_lens<T>};

}  // namespace

TIER_TABLE(PolarToImageKernels<float>) = kKernels<float>;
TIER_TABLE(PolarToImageKernels<double>) = kKernels<double>;
TIER_TABLE(PolarToImageKernels<bfloat16>) = kKernels<bfloat16>;

}  // namespace darswin
