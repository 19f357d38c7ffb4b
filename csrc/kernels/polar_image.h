// Reads pixels, packed or directly.
//
// If an image fits the second-level cache, its pixels are first copied into a packed image. There
// the channels come last and are padded to four, so that one load takes a pixel and its right
// neighbour. A border of zeros surrounds the image, so that the inner loop needs no bounds test. A
// point outside the image reads the zeros at the lower right, where the border is two pixels wide.
//
// A larger image, or one with too few points for a copy, is read directly, with any strides.
//
// 8-bit pixels are interpolated first, and the sample is normalized. Pixels outside count as 0
// after the normalization. So a sample is scale * (its pixels) + offset * (its coverage), where the
// coverage is the sum of the weights of the pixels inside: exactly 1 if all are. A packed image of
// 8 bits has the coverage of each pixel, 1, as a further channel.
#pragma once

#include "convert.h"
#include "polar_points.h"

namespace darswin {
namespace {

// Four channels, or as many channels as a register holds.
template <typename T>
using Piece = Vector<T, (kLanes<T> < 4 ? kLanes<T> : 4)>;

// The layout of a packed image. Pixel (x, y) of the image is pixel (x + 1, y + 1) of the packed
// image. The layout is only computed for images that are packed, or whose gradient is packed: the
// sizes of other images may not fit 64 bits.
struct Packed {
  int64_t pixel = 0, row = 0, size = 0;  // values of a pixel, of a row, of the image

  Packed() = default;
  template <typename T>
  Packed(const PolarSampleArgs<T>& a, int64_t pixel)
      : pixel(pixel), row((a.width + 3) * pixel), size((a.height + 3) * row) {}
};

// The places of a block of points among the pixels. `right` and `lower` are the distances from the
// upper left pixel, from 0 to 1. The last register of a row may reach beyond the row.
constexpr int kPlaces = kBlock + kDoubles;
template <typename T>
struct Places {
  T right[kPlaces], lower[kPlaces];
};
template <typename T>
struct PackedPlaces : Places<T> {
  int32_t offset[kPlaces];  // of the upper left pixel in the packed image
};
template <typename T>
struct DirectPlaces : Places<T> {
  int64_t column[kPlaces], row[kPlaces];  // of the upper left pixel
  int64_t offset[kPlaces];                // its offset, or -1 if not all four are inside
};

// Splits coordinates into whole and fractional parts, moved by one pixel as in a packed image.
// Coordinates that touch no pixel become `outside`, and so does NaN. This test is skipped if all
// coordinates are known to be `inside`.
template <bool inside, typename T>
inline Doubles split(Doubles x, double size, double outside, T* fraction) {
  Doubles moved = x + 1;
  if constexpr (!inside) moved = select((x > -1) & (x < size), moved, splat<Doubles>(outside));
  const Doubles whole = whole_part(moved);
  store(fraction, __builtin_convertvector(moved - whole, Vector<T, kDoubles>));
  return whole;
}

template <bool inside, typename T>
inline void place(const PolarSampleArgs<T>& a, const Packed& packed, const Points& p, int64_t k,
                  PackedPlaces<T>& places) {
  const double width = static_cast<double>(a.width), height = static_cast<double>(a.height);
  const Doubles column = split<inside>(p.x, width, width + 1, places.right + k);
  const Doubles row = split<inside>(p.y, height, height + 1, places.lower + k);
  const Doubles offset =
      row * static_cast<double>(packed.row) + column * static_cast<double>(packed.pixel);
  store(places.offset + k, to_ints(offset));
}

// Places points in an image that is read directly. A point that touches no pixel gets column or row
// -3. `strides` are the strides of the rows and the columns that are read or written. If all four
// pixels of every point are known to be `inside`, the columns and rows are not computed.
template <bool inside, typename T>
inline void place(const PolarSampleArgs<T>& a, const int64_t strides[2], const Points& p, int64_t k,
                  DirectPlaces<T>& places) {
  using Ints = Vector<int64_t, kDoubles>;
  const double width = static_cast<double>(a.width), height = static_cast<double>(a.height);
  const Doubles column = split<inside>(p.x, width, -2, places.right + k) - 1;
  const Doubles row = split<inside>(p.y, height, -2, places.lower + k) - 1;
  // This is exact in double below 2^53.
  Doubles offset = row * static_cast<double>(strides[0]) + column * static_cast<double>(strides[1]);
  if constexpr (!inside) {
    const auto whole = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1);
    offset = select(whole, offset, splat<Doubles>(-1.0));
    store(places.column + k, __builtin_convertvector(column, Ints));
    store(places.row + k, __builtin_convertvector(row, Ints));
  }
  store(places.offset + k, __builtin_convertvector(offset, Ints));
}

// The places of a block of points, in a packed image or for reading directly.
template <typename T>
struct PlacedPoints {
  union {
    PackedPlaces<T> packed;
    DirectPlaces<T> direct;
  };
  RandomWords random;

  // Finds points j to j + count of radius i of image b, and stores them from index `first` on.
  void find_packed(const PolarSampleArgs<T>& a, const Packed& layout, int64_t b, int64_t i,
                   int64_t j, int64_t count, int64_t first) {
    const auto put = [&]<bool inside>() {
      locate(a, b, i, j, count, random,
             [&](int64_t k, const Points& p) { place<inside>(a, layout, p, first + k, packed); });
    };
    within(a, b, i, -1) ? put.template operator()<true>() : put.template operator()<false>();
  }

  // Does the same for reading directly, with or without the columns and rows of points inside.
  template <bool columns>
  void find_direct(const PolarSampleArgs<T>& a, const int64_t strides[2], int64_t b, int64_t i,
                   int64_t j, int64_t count, int64_t first) {
    const auto put = [&]<bool inside>() {
      locate(a, b, i, j, count, random,
             [&](int64_t k, const Points& p) { place<inside>(a, strides, p, first + k, direct); });
    };
    const bool known = !columns && inside(a, b, i);
    known ? put.template operator()<true>() : put.template operator()<false>();
  }

  // Returns whether all four pixels around each point of a radius are known to be in the image.
  static bool inside(const PolarSampleArgs<T>& a, int64_t b, int64_t i) {
    constexpr double kSpare = 0.001;  // of a pixel, because positions are rounded
    return within(a, b, i, kSpare);
  }

 private:
  // Returns whether all points of a radius are known to lie inside the image, at least `margin`
  // away from the centers of the outermost pixels.
  static bool within(const PolarSampleArgs<T>& a, int64_t b, int64_t i, double margin) {
    if (a.offsets != nullptr || !a.directions_finite) return false;
    const Reach most = reach(a, b, i);
    const T* center = a.center + b * a.center_stride;
    const auto right = static_cast<double>(a.width - 1), lower = static_cast<double>(a.height - 1);
    return center[0] - most.x > margin && center[0] + most.x < right - margin &&
           center[1] - most.y > margin && center[1] + most.y < lower - margin;
  }
};

// Points that are read directly, in turn. Their indices in a block are first, first + step and so
// on.
struct Line {
  bool flat;                   // true: along the azimuth, false: along the radius
  int64_t row, token, sample;  // of the first point: its radius in the block, its index in a token
  int64_t first, step, count;
};

// Cuts a block that is read directly into lines. The block has `rows` radii with points j to j +
// columns each. Lines go token by token, with `token_width` points of each radius. Inside a token
// they go along the azimuth.
//
// An image of several planes is different: few of its points fill a set of the cache. There, lines
// follow the rows of the image, so that a point finds cache lines that the point before has
// touched. To the left and right of the center, this direction is along the radius.
template <typename T>
class Lines {
 public:
  Lines(const PolarSampleArgs<T>& a, int64_t j, int64_t rows, int64_t columns, int64_t token_width,
        bool planes)
      : a(a),
        j(j),
        rows(rows),
        columns(columns),
        width(smaller(token_width, columns)),
        planes(planes && rows > 1) {}

  bool any() const { return rows > 0 && column < columns; }

  Line next() {
    if (index == 0) {
      const double sin = a.sines[j + column], cos = a.cosines[j + column];
      flat = !planes || sin * sin > cos * cos;
    }
    const int64_t at = index++, from = column, in = token;
    const int64_t points = smaller(width, columns - column);  // of a radius of this token
    if (index == (flat ? rows : points)) {
      index = 0;
      column += width;
      ++token;
    }
    if (flat) return {true, at, in, 0, at * columns + from, 1, points};
    return {false, 0, in, at, from + at, columns, rows};
  }

 private:
  const PolarSampleArgs<T>& a;
  const int64_t j, rows, columns, width;
  const bool planes;
  // The current token, its first column, the index of its next line, and whether its lines go along
  // the azimuth.
  int64_t token = 0, column = 0, index = 0;
  bool flat = true;
};

// Calls visit(line) for the lines of a block, and fetch(line) some points earlier.
template <typename T, typename Fetch, typename Visit>
void visit_lines(const Lines<T>& all, Fetch fetch, Visit visit) {
  constexpr int64_t kAhead = 80;  // points
  Lines<T> lines = all, coming = all;
  for (int64_t lead = 0; lines.any();) {
    while (coming.any() && lead < kAhead) {
      const Line line = coming.next();
      fetch(line);
      lead += line.count;
    }
    const Line line = lines.next();
    visit(line);
    lead -= line.count;
  }
}

// Prefetches the pixels around the points of a line, in `planes` planes whose rows are `below`
// apart.
template <typename T, typename E>
void fetch_pixels(const DirectPlaces<T>& places, const Line& line, const E* pixels, int64_t planes,
                  int64_t plane, int64_t below) {
  for (int64_t k = 0; k < line.count; ++k) {
    const int64_t offset = places.offset[line.first + k * line.step];
    for (int64_t c = 0; c < planes && offset >= 0; ++c) {
      fetch(pixels + c * plane + offset);
      fetch(pixels + c * plane + offset + below);
    }
  }
}

// Calls visit<E>(), where E is the type of the pixels.
template <typename T, typename Visit>
void with_pixel_type(Pixel pixel, Visit visit) {
  if constexpr (sizeof(T) == sizeof(double)) {
    visit.template operator()<double>();
  } else if (pixel == Pixel::f32) {
    visit.template operator()<float>();
  } else if (pixel == Pixel::bf16) {
    visit.template operator()<bfloat16>();
  } else {
    visit.template operator()<uint8_t>();
  }
}

// Interpolates between four pixels, at distances from 0 to 1 from the upper left one.
template <typename V>
inline V bilinear(V top_left, V top_right, V bottom_left, V bottom_right, V right, V lower) {
  const V l = between(top_left, bottom_left, 1 - lower, lower);
  const V r = between(top_right, bottom_right, 1 - lower, lower);
  return between(l, r, 1 - right, right);
}

// Normalizes a sample of 8-bit pixels. At the border, its offset counts by the sample's coverage.
template <typename V>
inline V normalized(V sample, V scale, V offset) {
  return sample * scale + offset;
}
template <typename V>
inline V normalized(V sample, V scale, V offset, V coverage) {
  return normalized(sample, scale, unfused(offset * coverage));
}

// The four pixels around a point, read directly, one channel at a time. Any of them may lie
// outside.
template <typename T, typename E>
struct Corners {
  const PolarSampleArgs<T>& args;
  const E* image;
  int64_t first;                   // offset of the upper left pixel, channel 0
  bool left, right, upper, lower;  // which columns and rows are inside

  Corners(const PolarSampleArgs<T>& a, int64_t b, int64_t column, int64_t row)
      : args(a),
        image(static_cast<const E*>(a.image) + b * a.image_stride[0]),
        first(row * a.image_stride[2] + column * a.image_stride[3]),
        left(column >= 0 && column < a.width),
        right(column >= -1 && column + 1 < a.width),
        upper(row >= 0 && row < a.height),
        lower(row >= -1 && row + 1 < a.height) {}

  bool outside() const { return !(left || right) || !(upper || lower); }

  // Returns the upper left, upper right, lower left and lower right pixel. Pixels outside count as
  // 0.
  Vector<T, 4> read(int64_t channel) const {
    const E* p = image + first + channel * args.image_stride[1];
    const int64_t row = args.image_stride[2], column = args.image_stride[3];
    const T top_left = upper && left ? load<T>(p) : T(0);
    const T top_right = upper && right ? load<T>(p + column) : T(0);
    const T bottom_left = lower && left ? load<T>(p + row) : T(0);
    const T bottom_right = lower && right ? load<T>(p + row + column) : T(0);
    return Vector<T, 4>{top_left, top_right, bottom_left, bottom_right};
  }

  // Returns 1 for each of these pixels that is inside, and 0 for the others.
  Vector<T, 4> inside() const {
    return Vector<T, 4>{T(upper && left), T(upper && right), T(lower && left), T(lower && right)};
  }

  // Returns the values of the four pixels: those of 8 bits are normalized.
  Vector<T, 4> values(int64_t channel) const {
    if constexpr (is_same_v<E, uint8_t>) {
      using V = Vector<T, 4>;
      return normalized(read(channel), splat<V>(args.pixel_scale[channel]),
                        splat<V>(args.pixel_offset[channel]), inside());
    } else {
      return read(channel);
    }
  }

  // Interpolates between them. A sample of 8-bit pixels is normalized.
  T sample(int64_t channel, T right, T lower) const {
    const auto interpolate = [&](const Vector<T, 4>& p) {
      return bilinear(p[0], p[1], p[2], p[3], right, lower);
    };
    const T sample = interpolate(read(channel));
    if constexpr (is_same_v<E, uint8_t>) {
      return normalized(sample, args.pixel_scale[channel], args.pixel_offset[channel],
                        interpolate(inside()));
    } else {
      return sample;
    }
  }
};

}  // namespace
}  // namespace darswin
