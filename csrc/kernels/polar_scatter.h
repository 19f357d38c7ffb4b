// Computes the gradient of the image: each point adds its weighted gradient to the four pixels
// around it.
//
// For a small image the sums are kept in cells. All points between the same four pixels add to one
// cell, which has four channels for each of these pixels. A cell is one cache line, and one step
// adds to the whole line. At the end each pixel adds up its share of four cells. For a larger image
// the sums are kept in packed form (polar_image.h), one register for each pixel. For a still larger
// image the gradient itself holds the sums.
//
// Neighbouring points often add to the same pixel, and an addition must wait for the one before. So
// the points are taken from several arcs of the circle in turn.
#pragma once

#include "polar_direct.h"
#include "polar_rows.h"

namespace darswin {
namespace {

constexpr int64_t kCellBytes = 1 << 20;

template <typename T>
class Scatter {
 public:
  static int64_t bytes(const PolarSampleArgs<T>& a) {
    const int64_t kept_rows = units(a.height, a.bands) + 3;  // at most
    return round_up(sizeof(PlacedPoints<T>), 64) + tile_bytes(a) +
           kept_rows * sums_layout(a).row * static_cast<int64_t>(sizeof(T));
  }

  // Adds to band `band` of image b.
  Scatter(const PolarSampleArgs<T>& args, int64_t b, int64_t band, void* scratch)
      : a(args),
        keep(keeping(args)),
        layout(sums_layout(args)),
        image(b),
        first_row(band_row(band)),
        end_row(band_row(band + 1)),
        points(*static_cast<PlacedPoints<T>*>(scratch)),
        grads(reinterpret_cast<T*>(static_cast<char*>(scratch) +
                                   round_up(sizeof(PlacedPoints<T>), 64))),
        sums(grads + tile_bytes(args) / sizeof(T) - first_kept() * layout.row) {
    if (keep == kDirect) {
      T* rows =
          static_cast<T*>(a.grad_image) + (image * a.channels * a.height + first_row) * a.width;
      for (int64_t c = 0; c < a.channels; ++c, rows += a.height * a.width) {
        for (int64_t e = 0; e < (end_row - first_row) * a.width; ++e) rows[e] = 0;
      }
      return;
    }
    for (int64_t e = first_kept() * layout.row; e < end_kept() * layout.row; ++e) sums[e] = 0;
  }

  // Adds the gradients of all points, a tile of points after the other: their pixels and gradients
  // stay in the first-level cache.
  void add() {
    // A tile of cells is a part of one radius: neighbouring radii would add to the same cells.
    const int64_t tile_radii = keep == kCells ? 1 : 8, most = kBlock / tile_radii;
    const int64_t tile_azimuths =
        a.tokens && a.samples_a <= most ? most - most % a.samples_a : most;
    for (int64_t i = 0; i < a.num_radii; i += tile_radii) {
      const int64_t radii = smaller(tile_radii, a.num_radii - i);
      bool any = false;
      for (int64_t n = 0; n < radii; ++n) any |= touches(i + n);
      for (int64_t j = 0; any && j < a.num_azimuths; j += tile_azimuths) {
        const int64_t count = smaller(tile_azimuths, a.num_azimuths - j);
        keep == kDirect ? tile_direct(i, radii, j, count) : tile_kept(i, radii, j, count);
      }
    }
  }

  // Writes the sums to the gradient of the image.
  void finish() const {
    if (keep == kDirect) return;
    with_pixel_type<T>(a.pixel, [&]<typename E>() {
      if constexpr (sizeof(E) > 1) {
        E* to = static_cast<E*>(a.grad_image) + image * a.channels * a.height * a.width;
        for (int64_t y = first_row; y < end_row; ++y) {
          const T* from = sums + (y + 1) * layout.row + layout.pixel;
          if (keep == kCells) collect(from);
          for (int64_t c = 0; c < a.channels; c += 4) {
            write_row(from + c, smaller(4, a.channels - c), to + (c * a.height + y) * a.width);
          }
        }
      }
    });
  }

 private:
  enum Keeping { kCells, kPacked, kDirect };

  // The gradients of a tile. A load of four channels may reach beyond the last.
  static int64_t tile_bytes(const PolarSampleArgs<T>& a) {
    return round_up((kBlock * gradient_step(a) + 16) * sizeof(T), 64);
  }

  // bfloat16 gradients never hold the sums, because these are float32.
  static Keeping keeping(const PolarSampleArgs<T>& a) {
    if (!a.packed && a.pixel != Pixel::bf16) return kDirect;
    const bool cells =
        sizeof(T) == sizeof(float) && a.channels <= 4 && Packed(a, 4).size * 16 <= kCellBytes;
    return cells ? kCells : kPacked;
  }

  static Packed sums_layout(const PolarSampleArgs<T>& a) {
    if (keeping(a) == kDirect) return Packed();
    return Packed(a, keeping(a) == kCells ? 16 : round_up(a.channels, 4));
  }

  // The band keeps the sums of its rows of pixels. The outermost bands also keep the border. Cells
  // need the row above too, so two neighbouring bands each keep their own copy of this row.
  int64_t band_row(int64_t band) const { return a.height * band / a.bands; }
  int64_t first_kept() const { return first_row == 0 ? 0 : first_row + (keep == kCells ? 0 : 1); }
  int64_t end_kept() const { return end_row == a.height ? a.height + 3 : end_row + 1; }

  // Calls visit(k) for all k < count, taking several arcs in turn.
  template <typename Visit>
  static void in_turn(int64_t count, Visit visit) {
    constexpr int64_t arcs = 8;
    const int64_t each = count / arcs;
    for (int64_t k = 0; k < each; ++k) {
#pragma GCC unroll 8
      for (int64_t p = 0; p < arcs; ++p) visit(p * each + k);
    }
    for (int64_t k = each * arcs; k < count; ++k) visit(k);
  }

  // A cell holds (upper left, upper right, lower left, lower right), with four channels each.
  [[gnu::noinline]] void add_to_cells(int64_t count, const T* from) const {
    const int64_t step = gradient_step(a);
    const PackedPlaces<T>& places = points.packed;
    T* cells = sums;
    const int64_t begin = first_kept() * layout.row, end = end_kept() * layout.row;
    const bool banded = a.bands > 1;
    in_turn(count, [=, &places](int64_t k) {
      const int64_t offset = places.offset[k];
      if (banded && (offset < begin || offset >= end)) return;
      add_cell(cells + offset, from + k * step, places.right[k], places.lower[k]);
    });
  }

  static void add_cell(float* cell, const float* grad, float right, float lower) {
    constexpr int lanes = kLanes<float>;
    using V = Vector<float, lanes>;
    // The weights are 1 - right, right, ... and 1 - lower, ..., lower, ...
    constexpr float one_x[] = {1, 1, 1, 1, 0, 0, 0, 0, 1, 1, 1, 1, 0, 0, 0, 0};
    constexpr float sign_x[] = {-1, -1, -1, -1, 1, 1, 1, 1, -1, -1, -1, -1, 1, 1, 1, 1};
    constexpr float one_y[] = {1, 1, 1, 1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0};
    constexpr float sign_y[] = {-1, -1, -1, -1, -1, -1, -1, -1, 1, 1, 1, 1, 1, 1, 1, 1};
    const V g = repeat(load<Vector<float, 4>>(grad));
    for (int e = 0; e < 16; e += lanes) {
      const V x = load<V>(one_x + e) + right * load<V>(sign_x + e);
      const V y = load<V>(one_y + e) + lower * load<V>(sign_y + e);
      store(cell + e, load<V>(cell + e) + g * x * y);
    }
  }
  static void add_cell(double*, const double*, double, double) {}  // doubles are never in cells

  // Adds up the pixels of a row from the cells around each pixel. The sum replaces the front of the
  // pixel's own cell.
  void collect(const T* row) const {
    using V = Vector<T, 4>;
    T* cell = const_cast<T*>(row);
    for (int64_t x = 0; x < a.width; ++x, cell += layout.pixel) {
      const T *left = cell - layout.pixel, *above = cell - layout.row;
      // The front of the left cell already holds a sum. Its part for this pixel is still unchanged.
      store(cell, load<V>(cell) + load<V>(left + 4) +
                      (load<V>(above + 8) + load<V>(above - layout.pixel + 12)));
    }
  }

  // Writes up to four channels of a row of packed pixels to the planes of the image.
  template <typename E>
  void write_row(const T* from, int64_t channels, E* to) const {
    using V = Vector<T, 4>;
    const int64_t plane = a.height * a.width;
    int64_t x = 0;
    for (; x + 4 <= a.width; x += 4) {
      T turned[16];
      const auto pixel = [&](int64_t k) { return load<V>(from + (x + k) * layout.pixel); };
      transpose4(pixel(0), pixel(1), pixel(2), pixel(3), turned, 4);
      for (int64_t c = 0; c < channels; ++c) store(to + c * plane + x, load<V>(turned + 4 * c));
    }
    for (; x < a.width; ++x) {
      for (int64_t c = 0; c < channels; ++c) store(to + c * plane + x, from[x * layout.pixel + c]);
    }
  }

  [[gnu::noinline]] void add_to_packed(int64_t count, const T* from) const {
    const int64_t step = gradient_step(a);
    if (a.bands > 1) {
      in_turn(count, [=, this](int64_t k) { add_pixels<true>(k, from + k * step); });
    } else {
      in_turn(count, [=, this](int64_t k) { add_pixels<false>(k, from + k * step); });
    }
  }

  // Adds a point to those of its rows that are in the band.
  template <bool kBanded>
  void add_pixels(int64_t k, const T* grad) const {
    using V = Piece<T>;
    const V down = splat<V>(points.packed.lower[k]), right = splat<V>(points.packed.right[k]);
    const V up = 1 - down, left = 1 - right;
    const int64_t offset = points.packed.offset[k], pixel = layout.pixel;
    const bool upper = !kBanded || in_band(offset);
    const bool lower = !kBanded || in_band(offset + layout.row);
    T* top = sums + offset;
    T* bottom = top + layout.row;
    for (int64_t c = 0; c < pixel; c += kCount<V>) {
      const V g = load<V>(grad + c), above = unfused(g * up), below = unfused(g * down);
      if (upper) {
        store(top + c, load<V>(top + c) + unfused(above * left));
        store(top + pixel + c, load<V>(top + pixel + c) + unfused(above * right));
      }
      if (lower) {
        store(bottom + c, load<V>(bottom + c) + unfused(below * left));
        store(bottom + pixel + c, load<V>(bottom + pixel + c) + unfused(below * right));
      }
    }
  }

  // Returns whether a pixel of the packed image is in a row of the band.
  bool in_band(int64_t offset) const {
    return offset >= first_kept() * layout.row && offset < end_kept() * layout.row;
  }

  // Reads all gradients of a tile before any of them is used: a load of four channels that meets
  // two stores waits until both are in the cache.
  void read_tile(int64_t i, int64_t radii, int64_t j, int64_t count) {
    for (int64_t n = 0; n < radii; ++n) {
      read_points(a, image, i + n, j, count, grads + n * count * gradient_step(a));
    }
  }

  void tile_kept(int64_t i, int64_t radii, int64_t j, int64_t count) {
    read_tile(i, radii, j, count);
    for (int64_t n = 0; n < radii; ++n) {
      if (!touches(i + n)) continue;
      const T* from = grads + n * count * gradient_step(a);
      points.find_packed(a, layout, image, i + n, j, count, 0);
      keep == kCells ? add_to_cells(count, from) : add_to_packed(count, from);
    }
  }

  void tile_direct(int64_t i, int64_t radii, int64_t j, int64_t count) {
    const int64_t strides[2] = {a.width, 1}, gradient = gradient_step(a);
    read_tile(i, radii, j, count);
    for (int64_t n = 0; n < radii; ++n) {
      points.template find_direct<true>(a, strides, image, i + n, j, count, n * count);
    }
    const auto add = [&](const Line& line) {
      for (int64_t k = 0; k < line.count; ++k) {
        const int64_t index = line.first + k * line.step;
        add_point(index, grads + index * gradient);
      }
    };
    const auto fetch = [&](const Line& line) {
      const int64_t plane = a.height * a.width;
      const T* pixels = static_cast<T*>(a.grad_image) + image * a.channels * plane;
      fetch_pixels(points.direct, line, pixels, a.channels, plane, a.width);
    };
    visit_lines(Lines<T>(a, j, radii, count, 16, true), fetch, add);
  }

  void add_point(int64_t k, const T* grad) const {
    const int64_t column = points.direct.column[k], row = points.direct.row[k];
    const bool upper = row >= first_row && row < end_row;
    const bool lower = row + 1 >= first_row && row + 1 < end_row;
    if (!upper && !lower) return;
    const bool left = column >= 0 && column < a.width;
    const bool next = column >= -1 && column + 1 < a.width;
    const T by_down = points.direct.lower[k], by_right = points.direct.right[k];
    const T by_up = 1 - by_down, by_left = 1 - by_right;
    const T up_left = by_up * by_left, up_right = by_up * by_right;
    const T down_left = by_down * by_left, down_right = by_down * by_right;
    const int64_t plane = a.height * a.width;
    T* pixel = static_cast<T*>(a.grad_image) + image * a.channels * plane + row * a.width + column;
    if constexpr (is_same_v<T, float>) {
      if (upper && lower && left && next) {
        const Vector<float, 4> share{up_left, up_right, down_left, down_right};
        for (int64_t c = 0; c < a.channels; ++c, pixel += plane) {
          const auto sum = two_pairs(pixel, pixel + a.width) + unfused(grad[c] * share);
          const auto pairs = (Vector<double, 2>)sum;
          store_bits(pixel, pairs[0]);
          store_bits(pixel + a.width, pairs[1]);
        }
        return;
      }
    }
    for (int64_t c = 0; c < a.channels; ++c, pixel += plane) {
      if (upper && left) pixel[0] += unfused(grad[c] * up_left);
      if (upper && next) pixel[1] += unfused(grad[c] * up_right);
      if (lower && left) pixel[a.width] += unfused(grad[c] * down_left);
      if (lower && next) pixel[a.width + 1] += unfused(grad[c] * down_right);
    }
  }

  // Returns whether points of radius i may touch the band.
  bool touches(int64_t i) const {
    if (a.bands == 1) return true;
    const double y = a.center[image * a.center_stride + 1];
    const double most = reach(a, image, i).y + largest_offset(a, image, i) + 2;
    // Comparisons with NaN are false, so NaN counts as touching.
    return !(y + most < first_row || y - most > end_row);
  }

  const PolarSampleArgs<T>& a;
  const Keeping keep;
  const Packed layout;
  const int64_t image, first_row, end_row;
  PlacedPoints<T>& points;
  T* grads;  // of a tile
  T* sums;   // cells or packed image; only the band's rows are there
};

}  // namespace
}  // namespace darswin
