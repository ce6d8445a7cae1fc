/* Agent of the public board in C: Broyden's rule learns how the image moves with the joints.

   cc -O2 -o agent agent.c
   servotrack submit --command ./agent --name my-agent                                        */

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const double GAIN = 4.0, LEAST_MOVE = 0.03, TRUST = 0.3;
enum { PROBING = 6, LONGEST_LINE = 65536 };

static double J[2][2], q[2], f[2], max_joint_rate = 2.0;
static int steps;

/* Read the numbers behind "name": in a line of JSON. */
static void numbers(const char *line, const char *name, double *out, int count) {
    char key[64];
    snprintf(key, sizeof key, "\"%s\":", name);
    const char *at = strstr(line, key);
    if (at == NULL) exit(1);
    at += strlen(key);
    for (int i = 0; i < count; i++) {
        at += strspn(at, " [,");
        char *end;
        out[i] = strtod(at, &end);
        at = end;
    }
}

/* Update the Jacobian (px/rad) by the move since the last update. */
static void learn(const double *joints, const double *features) {
    double dq[2] = {joints[0] - q[0], joints[1] - q[1]};
    double size = dq[0] * dq[0] + dq[1] * dq[1];
    if (size < LEAST_MOVE * LEAST_MOVE) return;
    /* The first moves, of single joints, are believed. Later ones also hold the target's motion. */
    double share = steps <= PROBING + 1 ? 1.0 : TRUST;
    for (int i = 0; i < 2; i++) {
        double miss = features[i] - f[i] - (J[i][0] * dq[0] + J[i][1] * dq[1]);
        J[i][0] += share * miss * dq[0] / size;
        J[i][1] += share * miss * dq[1] / size;
    }
    memcpy(q, joints, sizeof q);
    memcpy(f, features, sizeof f);
}

static void act(const char *line, int is_reset) {
    double joints[2], features[2], goal[2], visible;
    numbers(line, "joint_angles", joints, 2);
    numbers(line, "features", features, 2);
    numbers(line, "goal", goal, 2);
    numbers(line, "visible", &visible, 1);
    if (is_reset) {
        memset(J, 0, sizeof J);
        memcpy(q, joints, sizeof q);
        memcpy(f, features, sizeof f);
        steps = 0;
    }
    if (visible == 1.0) learn(joints, features);
    steps += 1;
    if (steps <= PROBING) {
        puts(steps <= PROBING / 2 ? "[0.4, 0.0]" : "[0.0, 0.4]");
        return;
    }
    double a = J[0][0], b = J[0][1], c = J[1][0], d = J[1][1];
    double ex = goal[0] - features[0], ey = goal[1] - features[1];
    /* The inverse of the Jacobian, damped so that rates stay small where it is singular. */
    double determinant = a * d - b * c;
    double scale = GAIN * determinant / (determinant * determinant + 1e4) / max_joint_rate;
    printf("[%.17g, %.17g]\n", scale * (d * ex - b * ey), scale * (a * ey - c * ex));
}

int main(void) {
    static char line[LONGEST_LINE];
    while (fgets(line, sizeof line, stdin) != NULL) {
        if (strstr(line, "\"message\": \"environment\"") != NULL) {
            numbers(line, "max_joint_rate", &max_joint_rate, 1);
            continue;
        }
        if (strstr(line, "\"message\": \"end\"") != NULL) break;
        act(line, strstr(line, "\"message\": \"reset\"") != NULL);
        fflush(stdout);
    }
    return 0;
}
