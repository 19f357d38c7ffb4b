// Bilinear interpolation in an image that is read directly.
//
// There are four ways to read the pixels. If the channels are planes, it takes four points at a
// time, or sixteen by gathers on CPUs with fast gathers. If the channels of a pixel are neighbours
// in memory, it takes one point with all its channels. In other layouts, and for points that are
// not inside, it takes single values.
#pragma once

#include "polar_image.h"

namespace darswin {
namespace {

// Joins two values at `here` and two values at `there`, as floats.
template <typename E>
inline Vector<float, 4> two_pairs(const E* here, const E* there) {
  if constexpr (is_same_v<E, float>) {
    return (Vector<float, 4>)Vector<double, 2>{load_bits<double>(here), load_bits<double>(there)};
  } else {
    E both[4];
    __builtin_memcpy(both, here, 2 * sizeof(E));
    __builtin_memcpy(both + 2, there, 2 * sizeof(E));
    return load<Vector<float, 4>>(both);
  }
}

// The pixels around sixteen points, for registers of 512 bits. Gathers read a pixel and its right
// neighbour as one value of 64 bits. The struct is a template, because only tiers with such
// registers have gather_pairs and permuted.
template <typename T>
struct Sixteen {
  using V = Vector<T, 16>;
  using Offsets = Vector<int64_t, 32 / sizeof(T)>;
  using Index = Vector<int32_t, 16>;

  Offsets offset, offset2;  // of the upper left pixels
  V up, up2, down, down2;   // weights of the upper and the lower pixels, each twice
  V left, right;

  Sixteen(const DirectPlaces<T>& places, int64_t k)
      : offset(load<Offsets>(places.offset + k)), offset2(load<Offsets>(places.offset + k + 8)) {
    constexpr Index twice = {0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7};
    const V lower = load<V>(places.lower + k);
    down = permuted(lower, twice);
    down2 = permuted(lower, twice + 8);
    up = 1 - down, up2 = 1 - down2;
    right = load<V>(places.right + k);
    left = 1 - right;
  }

  bool inside() const { return !any_negative(offset | offset2); }

  // Returns bilinear samples of a plane whose rows are `below` apart.
  V sample(const T* plane, int64_t below) const {
    const T* bottom = plane + below;
    const V pairs = between(gather_pairs(plane, offset), gather_pairs(bottom, offset), up, down);
    const V pairs2 =
        between(gather_pairs(plane, offset2), gather_pairs(bottom, offset2), up2, down2);
    return between(evens(pairs, pairs2), odds(pairs, pairs2), left, right);
  }
};

// Stores sixteen samples of three channels, one after the other: value n belongs to channel n % 3.
template <typename T, int kFirst, typename V>
inline void store_third(const V& x, const V& y, const V& z, T* to) {
  constexpr auto of_two = [](int i) { return (kFirst + i) % 3 * 16 % 32 + (kFirst + i) / 3; };
  constexpr auto of_all = [](int i) { return (kFirst + i) % 3 < 2 ? i : 16 + (kFirst + i) / 3; };
  store(to + kFirst, shuffle<of_all>(shuffle<of_two>(x, y), z));
}
template <typename T, typename V = Vector<T, 16>>
inline void store_sixteen(const V& x, const V& y, const V& z, T* to) {
  store_third<T, 0>(x, y, z, to);
  store_third<T, 16>(x, y, z, to);
  store_third<T, 32>(x, y, z, to);
}

// The same for four samples.
inline void store_fours(Vector<float, 4> x, Vector<float, 4> y, Vector<float, 4> z, float* to) {
  const auto xy = __builtin_shufflevector(x, y, 0, 4, 2, 6);
  const auto yz = __builtin_shufflevector(y, z, 1, 5, 3, 7);
  const auto zx = __builtin_shufflevector(z, x, 0, 5, 2, 7);
  store(to, __builtin_shufflevector(xy, zx, 0, 1, 4, 5));
  store(to + 4, __builtin_shufflevector(yz, xy, 0, 1, 6, 7));
  store(to + 8, __builtin_shufflevector(zx, yz, 2, 3, 6, 7));
}

// The output of a line: channel c of sample k goes to to[k * step + c * channel]. A sample may have
// fewer than four values. If these are neighbours, a store of four values may reach beyond it if
// the next sample of the line follows there, or anywhere if `spare` is true.
template <typename T>
struct LineOutput {
  T* to;
  int64_t step, channel;
  bool spare;
};

// An image with pixels of type E, read at the places of a block of points.
template <typename T, typename E>
class DirectImage {
 public:
  DirectImage(const PolarSampleArgs<T>& args, int64_t b, const DirectPlaces<T>& places)
      : a(args),
        b(b),
        places(places),
        pixels(static_cast<const E*>(args.image) + b * args.image_stride[0]),
        channels(args.channels),
        channel(args.image_stride[1]),
        below(args.image_stride[2]),
        next(args.image_stride[3]),
        layout(layout_of(args)) {}

  // Returns from how many planes the channels of a pixel are read.
  int64_t planes() const { return layout == kTogether ? 1 : channels; }

  // Prefetches the pixels of a later line.
  void fetch(const Line& line) const {
    fetch_pixels(places, line, pixels, planes(), channel, below);
  }

  // Samples the first `count` points of the block by gathers, one after the other. The images are
  // gray or have three planes. The last sixteen points may include some that the step before has
  // already sampled. There is no prefetching, because gathers wait for many pixels at once.
  void block(int64_t count, const LineOutput<T>& out) const {
    if constexpr (kRegister == 64 && is_same_v<E, float>) {
      const Line all{true, 0, 0, 0, 0, 1, count};
      if (count < 16) return points(all, 0, count, out);
      for (int64_t k = 0; k < count; k += 16) {
        k = smaller(k, count - 16);
        const Sixteen<T> sixteen(places, k);
        if (!sixteen.inside()) {
          points(all, k, k + 16, out);
          continue;
        }
        T* to = out.to + k * out.step;
        const auto plane = [&](int64_t c) { return sixteen.sample(pixels + c * channel, below); };
        const auto first = plane(0);
        if (channels == 1) {
          store(to, first);
        } else if (out.channel == 1) {
          store_sixteen<T>(first, plane(1), plane(2), to);
        } else {
          store(to, first);
          store(to + out.channel, plane(1));
          store(to + 2 * out.channel, plane(2));
        }
      }
    }
  }

  void sample(const Line& line, const LineOutput<T>& out) const {
    if constexpr (is_same_v<T, float>) {
      switch (layout) {
        case kGray:
          return line.flat ? fours<1, true>(line, out) : fours<1, false>(line, out);
        case kThreePlanes:
          return line.flat ? fours<3, true>(line, out) : fours<3, false>(line, out);
        case kPlanes:
          return line.flat ? fours<0, true>(line, out) : fours<0, false>(line, out);
        case kTogether:
          if (channels == 2) return together<2>(line, out);
          if (channels == 3) return together<3>(line, out);
          return together<4>(line, out);
        case kAny:
          break;
      }
    }
    points(line, 0, line.count, out);
  }

 private:
  enum Layout { kGray, kThreePlanes, kPlanes, kTogether, kAny };
  using V = Vector<float, 4>;

  static Layout layout_of(const PolarSampleArgs<T>& a) {
    if (!is_same_v<T, float>) return kAny;
    if (a.image_stride[3] == 1) {
      return a.channels == 1 ? kGray : a.channels == 3 ? kThreePlanes : kPlanes;
    }
    const bool together = a.image_stride[1] == 1 && a.image_stride[3] >= a.channels;
    return together && a.channels > 1 && a.channels <= 4 ? kTogether : kAny;
  }

  // Samples a line, four points at a time. The last four may include points that the step before
  // has already sampled. `kRow` means that the points and their samples follow each other in
  // memory.
  template <int kChannels, bool kRow>
  void fours(const Line& line, const LineOutput<T>& out) const {
    if (line.count < 4) return points(line, 0, line.count, out);
    const int64_t step = kRow ? 1 : line.step;
    for (int64_t k = 0; k < line.count; k += 4) {
      k = smaller(k, line.count - 4);
      const int64_t first = line.first + k * step;
      const int64_t* offset = places.offset + first;
      if ((offset[0] | offset[step] | offset[2 * step] | offset[3 * step]) < 0) {
        points(line, k, k + 4, out);
      } else {
        four<kChannels, kRow>(first, step,
                              {out.to + k * out.step, out.step, out.channel, out.spare});
      }
    }
  }

  static V every(const float* from, int64_t step) {
    return V{from[0], from[step], from[2 * step], from[3 * step]};
  }

  // One load takes a pixel and its right neighbour.
  template <int kChannels, bool kRow>
  void four(int64_t first, int64_t step, const LineOutput<T>& out) const {
    const V right = every(places.right + first, step), lower = every(places.lower + first, step);
    const V down = __builtin_shufflevector(lower, lower, 0, 0, 1, 1);
    const V down2 = __builtin_shufflevector(lower, lower, 2, 2, 3, 3);
    const V up = 1 - down, up2 = 1 - down2, left = 1 - right;
    const E* point[4];
    for (int p = 0; p < 4; ++p) point[p] = pixels + places.offset[first + p * step];
    const auto plane = [&](int64_t c) {
      const int64_t top = c * channel, bottom = top + below;
      const V pairs = between(two_pairs(point[0] + top, point[1] + top),
                              two_pairs(point[0] + bottom, point[1] + bottom), up, down);
      const V pairs2 = between(two_pairs(point[2] + top, point[3] + top),
                               two_pairs(point[2] + bottom, point[3] + bottom), up2, down2);
      const V v = between(evens(pairs, pairs2), odds(pairs, pairs2), left, right);
      if constexpr (!is_same_v<E, uint8_t>) return v;
      return normalized(v, splat<V>(a.pixel_scale[c]), splat<V>(a.pixel_offset[c]));
    };
    // No computation is written in two branches. The compiler would move the common part out of
    // both branches. Half of the operations that it fuses elsewhere would then stay unfused.
    if constexpr (kChannels == 3) {
      const V x = plane(0), y = plane(1), z = plane(2);
      if (out.channel == 1) return store_three<kRow>(x, y, z, out);
      store_plane<kRow>(x, 0, out);
      store_plane<kRow>(y, 1, out);
      store_plane<kRow>(z, 2, out);
      return;
    }
    for (int64_t c = 0; c < (kChannels > 0 ? kChannels : channels); ++c) {
      store_plane<kRow>(plane(c), c, out);
    }
  }

  // Stores a channel of four samples.
  template <bool kRow>
  static void store_plane(V v, int64_t c, const LineOutput<T>& out) {
    T* to = out.to + c * out.channel;
    if (kRow && out.step == 1) return store(to, v);
    for (int p = 0; p < 4; ++p) to[p * out.step] = v[p];
  }

  // Stores four samples of three channels.
  template <bool kRow>
  static void store_three(V x, V y, V z, const LineOutput<T>& out) {
    if constexpr (kRow) {
      store_fours(x, y, z, out.to);
    } else if (out.spare) {
      transpose4(x, y, z, z, out.to, out.step);
    } else {
      for (int p = 0; p < 4; ++p) {
        T* to = out.to + p * out.step;
        to[0] = x[p], to[1] = y[p], to[2] = z[p];
      }
    }
  }

  template <int kChannels>
  void together(const Line& line, const LineOutput<T>& out) const {
    constexpr int kSkip = 4 - kChannels;
    V scale{}, shift{};
    for (int c = 0; is_same_v<E, uint8_t> && c < kChannels; ++c) {
      scale[c] = a.pixel_scale[c];
      shift[c] = a.pixel_offset[c];
    }
    int64_t whole = 0;  // the points that store four values
    if (out.channel == 1) {
      whole = kChannels == 4 || out.spare ? line.count : line.flat ? line.count - 1 : 0;
    }
    for (int64_t k = 0; k < line.count; ++k) {
      const int64_t index = line.first + k * line.step;
      if (places.offset[index] < 0) {
        points(line, k, k + 1, out);
        continue;
      }
      // The load of the right neighbour ends with its last channel, so that it stays in the image.
      const E *pixel = pixels + places.offset[index], *neighbour = pixel + next - kSkip;
      const V down = splat<V>(places.lower[index]), right = splat<V>(places.right[index]);
      const V up = 1 - down;
      const V l = between(load<V>(pixel), load<V>(pixel + below), up, down);
      const V n = between(load<V>(neighbour), load<V>(neighbour + below), up, down);
      const V r = __builtin_shufflevector(n, n, kSkip, kSkip + 1, (kSkip + 2) % 4, 3);
      V v = between(l, r, 1 - right, right);
      if constexpr (is_same_v<E, uint8_t>) v = normalized(v, scale, shift);
      T* to = out.to + k * out.step;
      if (k < whole) {
        store(to, v);
      } else {
        for (int c = 0; c < kChannels; ++c) to[c * out.channel] = v[c];
      }
    }
  }

  // Samples points [begin, end) of a line, which may lie on the border or outside.
  void points(const Line& line, int64_t begin, int64_t end, const LineOutput<T>& out) const {
    for (int64_t k = begin; k < end; ++k) {
      const int64_t index = line.first + k * line.step, offset = places.offset[index];
      const T right = places.right[index], lower = places.lower[index];
      T* to = out.to + k * out.step;
      if (offset < 0) {
        const Corners<T, E> corners(a, b, places.column[index], places.row[index]);
        for (int64_t c = 0; c < channels; ++c) {
          to[c * out.channel] = corners.sample(c, right, lower);
        }
        continue;
      }
      const E* pixel = pixels + offset;
      for (int64_t c = 0; c < channels; ++c, pixel += channel) {
        const E* bottom = pixel + below;
        const T sample = bilinear(load<T>(pixel), load<T>(pixel + next), load<T>(bottom),
                                  load<T>(bottom + next), right, lower);
        to[c * out.channel] = is_same_v<E, uint8_t>
                                  ? normalized(sample, a.pixel_scale[c], a.pixel_offset[c])
                                  : sample;
      }
    }
  }

  const PolarSampleArgs<T>& a;
  const int64_t b;
  const DirectPlaces<T>& places;
  const E* pixels;
  const int64_t channels, channel, below, next;  // strides to the next channel, row, column
  const Layout layout;
};

}  // namespace
}  // namespace darswin
