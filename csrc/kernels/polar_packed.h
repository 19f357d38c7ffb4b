// Packs an image, and samples the packed copy.
//
// Interpolation goes first downwards, then to the right, four channels at a time.
#pragma once

#include "polar_rows.h"

namespace darswin {
namespace {

// Packs the channels of image b from `first_channel` on, as many as a packed pixel holds. `planes`
// has room for 4 rows of the image. Channels beyond those of the image are 0, or 1 for pixels of 8
// bits.
template <typename T, typename E>
void pack(const PolarSampleArgs<T>& a, const Packed& packed, int64_t b, int64_t first_channel,
          T* planes, T* to) {
  constexpr T kBeyond = is_same_v<E, uint8_t>;
  const int64_t channels = smaller(a.channels - first_channel, packed.pixel);
  const int64_t channel_stride = a.image_stride[1], column_stride = a.image_stride[3];
  const E* image =
      static_cast<const E*>(a.image) + b * a.image_stride[0] + first_channel * channel_stride;
  const bool pixelwise = column_stride != 1 && packed.pixel == 4;
  for (int64_t y = 0; y < a.height; ++y) {
    const E* from = image + y * a.image_stride[2];
    T* row = to + (y + 1) * packed.row;
    for (int64_t e = 0; e < packed.pixel; ++e) row[e] = 0;
    row += packed.pixel;
    for (int64_t x = 0; x < a.width && pixelwise; ++x) {
      const E* pixel = from + x * column_stride;
      for (int64_t c = 0; c < 4; ++c) {
        row[4 * x + c] = c < channels ? load<T>(pixel + c * channel_stride) : kBeyond;
      }
    }
    for (int64_t first = 0; first < channels && !pixelwise; first += 4) {
      // Four channels as planes. A plane points into the image if it can be read as it is, and to a
      // converted copy otherwise.
      const T* plane[4];
      for (int64_t c = 0; c < 4; ++c) {
        T* copy = planes + c * a.width;
        plane[c] = copy;
        if (first + c >= channels) {
          for (int64_t x = 0; x < a.width; ++x) copy[x] = kBeyond;
          continue;
        }
        const E* source = from + (first + c) * channel_stride;
        if constexpr (sizeof(E) == sizeof(T)) {
          if (column_stride == 1) {
            plane[c] = source;
            continue;
          }
        }
        for (int64_t x = 0; x < a.width; ++x) copy[x] = load<T>(source + x * column_stride);
      }
      interleave(plane, a.width, row + first, packed.pixel);
    }
    row += a.width * packed.pixel;
    for (int64_t e = 0; e < 2 * packed.pixel; ++e) row[e] = 0;
  }
  for (int64_t e = 0; e < packed.row; ++e) to[e] = 0;
  for (int64_t e = (a.height + 1) * packed.row; e < packed.size; ++e) to[e] = 0;
}

// Packs a channel of image b by itself. A packed pixel has the four pixels around the points whose
// upper left pixel it is. `rows` has room for two rows of the image and their borders.
template <typename T, typename E>
void pack_corners(const PolarSampleArgs<T>& a, const Packed& packed, int64_t b, int64_t channel,
                  T* rows, T* to) {
  const int64_t width = a.width + 4;  // of a row and its borders
  const E* image =
      static_cast<const E*>(a.image) + b * a.image_stride[0] + channel * a.image_stride[1];
  const auto read = [&](int64_t y, T* row) {
    for (int64_t x = 0; x < width; ++x) row[x] = 0;
    const E* from = image + y * a.image_stride[2];
    for (int64_t x = 0; x < a.width && y < a.height; ++x) {
      row[x + 1] = load<T>(from + x * a.image_stride[3]);
    }
  };
  T *upper = rows, *lower = rows + width;
  for (int64_t x = 0; x < width; ++x) lower[x] = 0;
  for (int64_t y = 0; y < a.height + 3; ++y, to += packed.row) {
    T* const next = upper;  // std::swap would be a symbol that a tier leaks
    upper = lower, lower = next;
    read(y, lower);
    const T* const corners[] = {upper, upper + 1, lower, lower + 1};
    interleave<T>(corners, a.width + 3, to, 4);
  }
}

// Samples `count` points of such an image, one after the other.
template <typename T>
[[gnu::noinline]] void sample_corners(const T* pixels, const PackedPlaces<T>& places, int64_t first,
                                      int64_t count, T* to) {
  const int32_t* offset = places.offset + first;
  const T *right = places.right + first, *lower = places.lower + first;
  int64_t k = 0;
  if constexpr (is_same_v<T, float>) {
    constexpr int kL = kLanes<float>;
    for (; count >= kL && k < count; k += kL) {
      k = smaller(k, count - kL);  // the last points may be sampled again
      Floats v[4];                 // v[p] has points p, p + 4, ..., and then corner p of all points
#pragma GCC unroll 4
      for (int p = 0; p < 4; ++p) v[p] = quads(pixels, offset + k + p);
      transpose_quads(v);
      store(to + k,
            bilinear(v[0], v[1], v[2], v[3], load<Floats>(right + k), load<Floats>(lower + k)));
    }
  }
  for (; k < count; ++k) {
    const T* p = pixels + offset[k];
    to[k] = bilinear(p[0], p[1], p[2], p[3], right[k], lower[k]);
  }
}

// Interpolates four channels of a point, and calls write(e, v) for the channels from e on. The
// arguments are the upper left and the lower left pixel; their right neighbours follow them in
// memory.
template <typename T, typename Write>
inline void interpolate(const T* pixel, const T* below, T right, T lower, Write write) {
  using V = Piece<T>;
#pragma GCC unroll 2
  for (int e = 0; e < 4; e += kCount<V>) {
    write(e, bilinear(load<V>(pixel + e), load<V>(pixel + 4 + e), load<V>(below + e),
                      load<V>(below + 4 + e), splat<V>(right), splat<V>(lower)));
  }
}

// Interpolates the points 0 and `step` in a register of 256 bits. One load takes a pixel and its
// right neighbour.
template <int step, typename T>
inline Vector<T, 8> interpolate_two(const T* pixels, const T* below, const int32_t* offset,
                                    const T* right, const T* lower) {
  using V = Vector<T, 8>;
  const auto pair = [&](int k) {
    const V down = splat<V>(lower[k]);
    return between(load<V>(pixels + offset[k]), load<V>(below + offset[k]), 1 - down, down);
  };
  const V first = pair(0), second = pair(step);
  const V along = __builtin_shufflevector(splat<V>(right[0]), splat<V>(right[step]), 0, 1, 2, 3, 12,
                                          13, 14, 15);
  return between(even_quads(first, second), odd_quads(first, second), 1 - along, along);
}

// Interpolates the points first, first + step, first + 2 * step and first + 3 * step in a register
// of 512 bits. It first takes two pairs of pixels and the two pairs below them, then four pixels
// and their right neighbours. Loads and stores limit the speed of a single point. Here one load
// brings the weights of four points or of all sixteen. The function is a template, because only
// tiers with such registers have two_eights, pick and permuted.
template <int step, typename T>
inline Vector<T, 16> interpolate_four(const T* pixels, const T* below, const int32_t* offset,
                                      const T* right, const T* lower, int first) {
  using V = Vector<T, 16>;
  using Index = Vector<int32_t, 16>;
  constexpr Index two = {0, 0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 1};
  constexpr Index all = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
  const auto weights = [&](const T* of, Index point) {
    if constexpr (step == 1) {
      return pick(load<Vector<T, 4>>(of + first), point);
    } else {
      return permuted(load<V>(of), step * point + first);
    }
  };
  const auto pairs = [&](int point) {
    const int32_t at = offset[first + point * step], next = offset[first + (point + 1) * step];
    const V down = weights(lower, two + point);
    return between(two_eights(pixels + at, pixels + next), two_eights(below + at, below + next),
                   1 - down, down);
  };
  const V front = pairs(0), back = pairs(2), along = weights(right, all);
  return between(even_quads(front, back), odd_quads(front, back), 1 - along, along);
}

// How samples are normalized: not at all, or as those of 8-bit pixels inside the image, or as those
// of 8-bit pixels of which some may lie outside. The last of four channels is then the coverage.
enum class Normalization { none, inside, border };

template <Normalization how, typename V>
inline V finished(V v, V scale, V offset) {
  if constexpr (how == Normalization::none) {
    return v;
  } else if constexpr (how == Normalization::inside) {
    return normalized(v, scale, offset);
  } else {
    return normalized(v, scale, offset, shuffle<[](int i) { return i | 3; }>(v, v));
  }
}

// The output of a block of points: point k goes to to[target[k]]. room[k] is the number of values
// from there to the end of the row of a token, but at most kRoom.
constexpr int64_t kRoom = 16;
struct Targets {
  int32_t target[kBlock], room[kBlock];
};

// Samples `count` points of a packed image.
//
// A point stores four values even if it has fewer channels. The next point of the row comes later
// and overwrites the excess. But the memory after a token may hold finished values, or another
// thread may write there. So the last points of a token's last row, which begins at point
// `last_row`, store only their own values.
//
// This is a separate function, so that all its values stay in registers.
template <Normalization how, typename T>
[[gnu::noinline]] void sample_points(const PolarSampleArgs<T>& a, const T* pixels, int64_t row,
                                     const PackedPlaces<T>& places, int64_t last_row, int64_t count,
                                     const Targets& targets, T* to) {
  const T* below = pixels + row;
  const int64_t channels = a.channels;
  const int32_t *offset = places.offset, *target = targets.target, *room = targets.room;
  const T *right = places.right, *lower = places.lower;
  using V = Vector<T, 4>;
  constexpr bool bytes = how != Normalization::none;
  const V scale = bytes ? load<V>(a.pixel_scale) : V{};
  const V shift = bytes ? load<V>(a.pixel_offset) : V{};
  int64_t k = 0;
  if constexpr (is_same_v<T, float> && kRegister == 64) {
    const auto scales = repeat(scale), shifts = repeat(shift);
    for (; k + 4 <= count; k += 4) {
      const auto v = finished<how>(
          interpolate_four<1>(pixels, below, offset + k, right + k, lower + k, 0), scales, shifts);
      if (room[k] >= 4 * channels) {
        store_quarters(to + target[k], v, channels);
      } else {
        scatter_quarters(to, v, target + k, channels);
      }
    }
  }
  const auto sample = [&](int64_t k, T* out) {
    interpolate(pixels + offset[k], below + offset[k], right[k], lower[k], [&](int e, auto v) {
      if constexpr (bytes) v = finished<how>(v, scale, shift);
      store(out + e, v);
    });
  };
  if constexpr (is_same_v<T, float> && kRegister == 32) {
    const auto scales = repeat(scale), shifts = repeat(shift);
    for (; k + 2 <= last_row; k += 2) {
      const auto v = finished<how>(
          interpolate_two<1>(pixels, below, offset + k, right + k, lower + k), scales, shifts);
      store(to + target[k], lower_half(v));
      store(to + target[k + 1], upper_half(v));
    }
  }
  for (; k + 4 <= last_row; k += 4) {
#pragma GCC unroll 4
    for (int turn = 0; turn < 4; ++turn) sample(k + turn, to + target[k + turn]);
  }
  for (; k < count; ++k) {
    if (k < last_row || (room[k] >= 4 && k + 4 <= count)) {
      sample(k, to + target[k]);
      continue;
    }
    T v[4];
    sample(k, v);
#pragma GCC unroll 4
    for (int c = 0; c < 4; ++c) {
      if (c < channels) to[target[k] + c] = v[c];
    }
  }
}

// Samples `count` points of up to four channels of a packed image. Channel c of point k goes to
// to[c * plane + k].
template <Normalization how, typename T>
[[gnu::noinline]] void sample_planes(const PolarSampleArgs<T>& a, const T* pixels, int64_t row,
                                     const PackedPlaces<T>& places, int64_t first, int64_t count,
                                     int64_t channels, int64_t plane, T* to) {
  const T* below = pixels + row;
  const int32_t* offset = places.offset + first;
  const T *right = places.right + first, *lower = places.lower + first;
  using V = Vector<T, 4>;
  constexpr bool bytes = how != Normalization::none;
  const V scale = bytes ? load<V>(a.pixel_scale) : V{};
  const V shift = bytes ? load<V>(a.pixel_offset) : V{};
  int64_t k = 0;
  if constexpr (is_same_v<T, float> && kRegister >= 32) {
    // v[p] has points p, p + 4, ... of a register of planes, so that the transposition of each 128
    // bits puts all points in their order. The last register may include points that the step
    // before has already sampled.
    constexpr int kL = kLanes<float>;
    const auto scales = repeat(scale), shifts = repeat(shift);
    for (; count >= kL && k < count; k += kL) {
      k = smaller(k, count - kL);
      Floats v[4];
#pragma GCC unroll 4
      for (int p = 0; p < 4; ++p) {
        if constexpr (kRegister == 64) {
          v[p] = interpolate_four<4>(pixels, below, offset + k, right + k, lower + k, p);
        } else {
          v[p] = interpolate_two<4>(pixels, below, offset + k + p, right + k + p, lower + k + p);
        }
        v[p] = finished<how>(v[p], scales, shifts);
      }
      transpose_quads(v);
#pragma GCC unroll 4
      for (int c = 0; c < 4; ++c) {
        if (c < channels) store(to + c * plane + k, v[c]);
      }
    }
  }
  for (; k < count; ++k) {
    interpolate(pixels + offset[k], below + offset[k], right[k], lower[k], [&](int e, auto v) {
      if constexpr (bytes) v = finished<how>(v, scale, shift);
      for (int c = 0; c < kCount<decltype(v)>; ++c) {
        if (e + c < channels) to[(e + c) * plane + k] = v[c];
      }
    });
  }
}

}  // namespace
}  // namespace darswin
