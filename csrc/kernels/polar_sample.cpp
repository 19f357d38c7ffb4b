// Polar bilinear sampling.
//
// A polar grid is separable: point (i, j) needs radius i and azimuth j, so two short vectors stand
// for the whole (N_r, N_a, 2) mesh that grid_sample would read. Each point finds its four pixels
// and their weights once (Corners) and then walks the channels. Places are computed in double: in
// float a coordinate of 100 px is only good to 1e-5 px, the largest error of the whole operation.
// Jitter moves a point by a fraction of a cell along both vectors, from a counter-based generator,
// so that backward finds the same point again. A point outside the image, or at no number at all,
// has no corners: zeros forward, nothing backward. Backward scatters into pixels that several
// points share, so one thread owns an image.
#include "kernels.h"
#include "philox.h"

namespace darswin::TIER {
namespace {

struct Point {
  double x, y;      // px
  double cos, sin;  // of its azimuth
  double shift;     // radius = radii[i] + shift * (radii[above] - radii[below])
  int64_t below, above;
  bool moves;  // false where the radius was clamped at 0
};

template <typename T>
Point locate(const PolarSampleArgs<T>& args, int64_t b, int64_t i, int64_t j) {
  const T* radii = args.radii + b * args.radii_stride;
  const T* center = args.center + b * args.center_stride;
  Point p{0, 0, args.cosines[j], args.sines[j], 0, i, i, true};
  double radius = radii[i];
  if (args.jitter > 0) {
    const PhiloxWords words = philox(args.seed, static_cast<uint64_t>(i * args.num_azimuths + j),
                                     static_cast<uint64_t>(b));
    p.shift = centered_uniform(words.word[0]) * args.jitter;
    const int64_t last = args.num_radii - 1;
    p.below = p.shift < 0 ? (i > 0 ? i - 1 : 0) : (i < last ? i : (last > 0 ? last - 1 : 0));
    p.above = p.below < last ? p.below + 1 : last;
    radius += p.shift * (static_cast<double>(radii[p.above]) - radii[p.below]);
    if (radius < 0) {
      radius = 0;
      p.moves = false;
    }
    const double cell = 2 * 3.14159265358979323846 / args.num_azimuths;
    const double turn = centered_uniform(words.word[1]) * args.jitter * cell;
    const double c = __builtin_cos(turn), s = __builtin_sin(turn);
    const double cos = p.cos * c - p.sin * s;
    p.sin = p.sin * c + p.cos * s;
    p.cos = cos;
  }
  p.x = center[0] + radius * p.cos;
  p.y = center[1] + radius * p.sin;
  return p;
}

// The four pixels around a point: those outside the image are not read and count as 0.
template <typename T>
struct Corners {
  int64_t offset[4];  // into one channel of the image: upper left, upper right, lower left, right
  bool inside[4];
  T weight[4];
  T right, lower;  // fraction of the way to the right and to the lower pixel

  T pixel(const T* channel, int k) const { return inside[k] ? channel[offset[k]] : T(0); }
};

// False where the point touches no pixel. Written so that NaN is false.
template <typename T>
bool find_corners(const PolarSampleArgs<T>& args, double x, double y, Corners<T>& c) {
  const double width = static_cast<double>(args.width), height = static_cast<double>(args.height);
  if (!(x > -1 && x < width && y > -1 && y < height)) return false;
  const double left = __builtin_floor(x), top = __builtin_floor(y);
  const int64_t x0 = static_cast<int64_t>(left), y0 = static_cast<int64_t>(top);
  c.right = static_cast<T>(x - left);
  c.lower = static_cast<T>(y - top);
  const T wx[2] = {1 - c.right, c.right}, wy[2] = {1 - c.lower, c.lower};
  for (int k = 0; k < 4; ++k) {
    const int64_t column = x0 + (k & 1), row = y0 + (k >> 1);
    c.inside[k] = column >= 0 && column < args.width && row >= 0 && row < args.height;
    c.offset[k] = row * args.image_stride[2] + column * args.image_stride[3];
    c.weight[k] = wx[k & 1] * wy[k >> 1];
  }
  return true;
}

// Where the points of one image and radius lie in the output: point (sector, s) of channel c at
// base + sector * sector_stride + s * sample_stride + c * channel_stride.
struct OutputRow {
  int64_t base, sector_stride, sample_stride, channel_stride;
};

template <typename T>
OutputRow output_row(const PolarSampleArgs<T>& args, int64_t b, int64_t i) {
  if (!args.tokens) {
    const int64_t plane = args.num_radii * args.num_azimuths;
    return {b * args.channels * plane + i * args.num_azimuths, args.patch_azimuths, 1, plane};
  }
  const int64_t rings = args.num_radii / args.patch_radii;
  const int64_t sectors = args.num_azimuths / args.patch_azimuths;
  const int64_t token = args.patch_radii * args.patch_azimuths * args.channels;
  const int64_t ring = b * rings + i / args.patch_radii, row = i % args.patch_radii;
  return {ring * sectors * token + row * args.patch_azimuths * args.channels, token, args.channels,
          1};
}

// Calls visit(j, offset into the output) for the points of one image and radius.
template <typename T, typename Visit>
void for_each_point(const PolarSampleArgs<T>& args, const OutputRow& row, Visit visit) {
  const int64_t sectors = args.num_azimuths / args.patch_azimuths;
  for (int64_t sector = 0; sector < sectors; ++sector) {
    for (int64_t s = 0; s < args.patch_azimuths; ++s) {
      visit(sector * args.patch_azimuths + s,
            row.base + sector * row.sector_stride + s * row.sample_stride);
    }
  }
}

template <typename T>
void sample(const PolarSampleArgs<T>& args, int64_t begin, int64_t end) {
  for (int64_t item = begin; item < end; ++item) {
    const int64_t b = item / args.num_radii, i = item % args.num_radii;
    const T* image = args.image + b * args.image_stride[0];
    const OutputRow row = output_row(args, b, i);
    for_each_point(args, row, [&](int64_t j, int64_t offset) {
      T* out = args.out + offset;
      const Point p = locate(args, b, i, j);
      Corners<T> c;
      if (!find_corners(args, p.x, p.y, c)) {
        for (int64_t k = 0; k < args.channels; ++k) out[k * row.channel_stride] = 0;
        return;
      }
      for (int64_t k = 0; k < args.channels; ++k) {
        const T* channel = image + k * args.image_stride[1];
        T value = 0;
        for (int q = 0; q < 4; ++q) value += c.weight[q] * c.pixel(channel, q);
        out[k * row.channel_stride] = value;
      }
    });
  }
}

// Gradients of one point: into the pixels, and d(loss)/d(x, y).
template <typename T>
void scatter(const PolarSampleArgs<T>& args, int64_t b, const Corners<T>& c, const T* grad,
             int64_t channel_stride, T* gx, T* gy) {
  const int64_t plane = args.height * args.width;
  *gx = *gy = 0;
  for (int64_t k = 0; k < args.channels; ++k) {
    const T g = grad[k * channel_stride];
    const int64_t channel = (b * args.channels + k) * plane;
    if (args.grad_image != nullptr) {
      for (int q = 0; q < 4; ++q) {
        if (c.inside[q]) args.grad_image[channel + c.offset[q]] += c.weight[q] * g;
      }
    }
    if (args.grad_radii != nullptr) {
      T pixel[4];
      for (int q = 0; q < 4; ++q) pixel[q] = c.pixel(args.image + channel, q);
      *gx += g * ((pixel[1] - pixel[0]) * (1 - c.lower) + (pixel[3] - pixel[2]) * c.lower);
      *gy += g * ((pixel[2] - pixel[0]) * (1 - c.right) + (pixel[3] - pixel[1]) * c.right);
    }
  }
}

template <typename T>
void sample_backward(const PolarSampleArgs<T>& args, int64_t begin, int64_t end) {
  for (int64_t b = begin; b < end; ++b) {
    for (int64_t i = 0; i < args.num_radii; ++i) {
      const OutputRow row = output_row(args, b, i);
      for_each_point(args, row, [&](int64_t j, int64_t offset) {
        const Point p = locate(args, b, i, j);
        Corners<T> c;
        if (!find_corners(args, p.x, p.y, c)) return;
        T gx, gy;
        scatter(args, b, c, args.grad_out + offset, row.channel_stride, &gx, &gy);
        if (args.grad_radii == nullptr) return;
        args.grad_center[b * 2] += gx;
        args.grad_center[b * 2 + 1] += gy;
        if (!p.moves) return;
        double* grad_radii = args.grad_radii + b * args.num_radii;
        const double along = gx * p.cos + gy * p.sin;
        grad_radii[i] += along;
        grad_radii[p.above] += along * p.shift;
        grad_radii[p.below] -= along * p.shift;
      });
    }
  }
}

}  // namespace

void polar_sample(const PolarSampleArgs<float>& args, int64_t begin, int64_t end) {
  sample(args, begin, end);
}
void polar_sample(const PolarSampleArgs<double>& args, int64_t begin, int64_t end) {
  sample(args, begin, end);
}
void polar_sample_backward(const PolarSampleArgs<float>& args, int64_t begin, int64_t end) {
  sample_backward(args, begin, end);
}
void polar_sample_backward(const PolarSampleArgs<double>& args, int64_t begin, int64_t end) {
  sample_backward(args, begin, end);
}

}  // namespace darswin::TIER
